"""Base class of all kinds of ``[source]``."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from bms_estimator.model.config_file import Strict

Name = Annotated[str, Field(min_length=1)]


class PolledSource(Strict):
    """Base class of all kinds of ``[source]``."""

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]; values count as fresh for three periods."""
        raise NotImplementedError

    @property
    def described(self) -> str:
        """Description in a few words."""
        raise NotImplementedError

    @property
    def sensor(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults of the source: resolution, sign of the current."""
        return {}


def with_profile(table: object, profiles: Mapping[str, Mapping[str, object]]) -> object:
    """Add the defaults of its ``profile`` to a settings section.

    Raises:
        ValueError: The profile is unknown.
    """
    if not isinstance(table, dict) or not isinstance(name := table.get("profile"), str):
        return table
    if name not in profiles:
        raise ValueError(f"profile: {name!r} must be one of {', '.join(profiles)}")
    return {**profiles[name], **table}
