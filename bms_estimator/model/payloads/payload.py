"""Base class and version of all published payloads.

A missing number is ``None``, because JSON has no NaN. The field descriptions are published as JSON schema.
"""

from functools import cached_property
from typing import Self

from pydantic import BaseModel, ConfigDict

PAYLOAD_VERSION = 3
"""Version of all payloads; ``sinks/mqtt/topics.py`` defines when it increases."""


class Payload(BaseModel):
    """Base class of all payloads."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @cached_property
    def json_bytes(self) -> bytes:
        """JSON text, serialized once for all sinks."""
        return self.model_dump_json().encode()

    def __copy__(self) -> Self:
        """Copy without the cached JSON, because ``model_copy`` changes fields afterwards."""
        copied = super().__copy__()
        copied.__dict__.pop("json_bytes", None)
        return copied
