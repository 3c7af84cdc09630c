"""Settings that all kinds of ``[source]`` share."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from bms_estimator.model.config_file import Strict

Name = Annotated[str, Field(min_length=1)]


class PolledSource(Strict):
    """Settings that all kinds of sources share."""

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]; values are fresh for three of them."""
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
    """Fill a settings section from its ``profile`` where it leaves a value out.

    Raises:
        ValueError: There is no profile of this name.
    """
    if not isinstance(table, dict) or not isinstance(name := table.get("profile"), str):
        return table
    if name not in profiles:
        raise ValueError(f"profile: {name!r} is none of {', '.join(profiles)}")
    return {**profiles[name], **table}
