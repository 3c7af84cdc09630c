"""Settings of known devices, by name."""

from collections.abc import Mapping


def with_profile(table: object, profiles: Mapping[str, Mapping[str, object]]) -> object:
    """A section of the settings with what its ``profile`` says and it does not.

    Raises:
        ValueError: There is no profile of this name.
    """
    if not isinstance(table, dict) or not isinstance(name := table.get("profile"), str):
        return table
    if name not in profiles:
        raise ValueError(f"profile: {name!r} is none of {', '.join(profiles)}")
    return {**profiles[name], **table}
