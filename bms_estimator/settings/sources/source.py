"""Base class of all kinds of ``[source]``, and the merging of their profiles."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from bms_estimator.model.config_file import Strict, suggestion

Name = Annotated[str, Field(min_length=1)]


class BaseSource(Strict):
    """Base class of all kinds of ``[source]``, which are the devices and programs that are not on a serial port."""

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]; a value is stale after three such periods."""
        raise NotImplementedError

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        raise NotImplementedError

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults of the source: resolution, sign of the current."""
        return {}


def as_tuple(value: object) -> object:
    """Return a list unchanged, and another value as a tuple of one item, because a quantity may have one location or several."""
    return value if isinstance(value, list | tuple) else () if value is None else (value,)


def merge_profile(table: object, profiles: Mapping[str, Mapping[str, object]]) -> object:
    """Return a table ``[source]`` with the defaults of the profile that it names; other tables are returned unchanged.

    Args:
        table: Table before its validation.
        profiles: Defaults of ``[source]`` by the name of the profile.

    Raises:
        ValueError: The profile is unknown.
    """
    if not isinstance(table, dict) or not isinstance(name := table.get("profile"), str):
        return table
    if name not in profiles:
        raise ValueError(f"profile: {name!r} must be one of {', '.join(profiles)}{suggestion(name, profiles)}")
    return {**profiles[name], **table}
