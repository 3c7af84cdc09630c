"""Values for Home Assistant: a value is published when it has moved and enough time has passed.

Its recorder writes a row for each. If all entities change constantly, those that were unchanged longest come first.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from bms_estimator.model.payloads import Snapshot
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs
from bms_estimator.sinks.home_assistant.entities import Entity, cell_key, entities

MAX_ROWS = 18
"""Maximum number of default-enabled values published in a minute; two more are reserved for alarms."""
MINUTE_S = 60.0
PAUSE_S = 5.0
"""Interval between two messages with values [s]."""
HEARTBEAT_S = 10.0
"""Interval at which unchanged values are repeated, so that they do not expire [s]."""


class EntityStates(NamedTuple):
    """Values that Home Assistant has. Times are on a monotonic clock [s]."""

    values: Mapping[str, float | None] = {}
    changed_s: Mapping[str, float] = {}
    told_s: float = -math.inf
    rows_s: tuple[float, ...] = ()
    """Times at which values were published in the last minute."""


def values_to_publish(
    shown: EntityStates, snapshot: Snapshot, described: DiscoveryInputs, now_s: float, *, sign: float = 1.0
) -> EntityStates:
    """Return the values to publish; ``shown`` itself if nothing changed enough.

    Args:
        shown: Values published last.
        snapshot: The snapshot.
        described: Data of the existing entities.
        now_s: Monotonic clock [s].
        sign: -1: charging is positive for current and power.
    """
    waited_s = now_s - shown.told_s
    if snapshot.estimate is None or waited_s < PAUSE_S:
        return shown
    shows = entities(described.info, described.cells)
    moved = {k: v for k, v in _rounded(snapshot, shows, sign).items() if _moved(shown, k, v, shows[k], now_s)}
    recent_s = tuple(at_s for at_s in shown.rows_s if now_s - at_s < MINUTE_S)
    rows = [key for key in moved if shows[key].enabled and key in shown.values]
    rows.sort(key=lambda key: shown.changed_s[key])
    for late in rows[MAX_ROWS - len(recent_s) :]:
        del moved[late]
    if not moved and waited_s < HEARTBEAT_S:
        return shown
    return shown._replace(
        values={**shown.values, **moved},
        changed_s={**shown.changed_s, **dict.fromkeys(moved, now_s)},
        told_s=now_s,
        rows_s=(*recent_s, *[now_s for key in rows if key in moved]),
    )


def _rounded(snapshot: Snapshot, shows: Mapping[str, Entity], sign: float) -> dict[str, float | None]:
    """Return the rounded value of each entity; None without a value."""
    values, rounded = _values(snapshot), dict[str, float | None]()
    for key, entity in shows.items():
        value = values.get(key)
        if value is not None and entity.signed:
            value *= sign
        rounded[key] = None if value is None else round(value, entity.decimals or None) or 0  # an integer, and no -0.0
    return rounded


def _values(snapshot: Snapshot) -> dict[str, float | None]:
    """All that a snapshot has, by the keys of the entities."""
    estimate, parameters = snapshot.estimate, snapshot.parameters
    assert estimate is not None  # noqa: S101 - for the type checker: nothing is published without
    health = parameters.state_of_health.get("capacity")
    return {
        **vars(estimate),
        **{key: element.value for key, element in parameters.elements.items()},
        "soc_std_percent": _times(100.0, estimate.soc_std),
        "time_to_empty_h": _times(1.0 / 3600.0, estimate.time_to_empty_s),
        "time_to_full_h": _times(1.0 / 3600.0, estimate.time_to_full_s),
        "soh_percent": _times(100.0, health.value if health else None),
        "soh_std_percent": _times(100.0, health.std if health else None),
        **{cell_key(number): volts for number, volts in enumerate(estimate.cells_v or (), start=1)},
    }


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


def _moved(shown: EntityStates, key: str, value: float | None, entity: Entity, now_s: float) -> bool:
    """Return True if a value should be published again."""
    if key not in shown.values:
        return True
    before, rested = shown.values[key], now_s - shown.changed_s[key] >= entity.min_interval_s
    if value is None or before is None:
        return rested and value is not before
    return round(abs(value - before), entity.decimals) >= (entity.step if rested else entity.immediate_step)
