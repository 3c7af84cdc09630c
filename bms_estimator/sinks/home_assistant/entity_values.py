"""Selection of values for Home Assistant. A value is published if it has changed enough and its minimum interval has passed.

Home Assistant's recorder writes a row for each published value. Therefore this module limits the number of values a
minute. If more entities change, those published longest ago come first.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from bms_estimator.model.payloads import Snapshot
from bms_estimator.model.quantity import Entity
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs
from bms_estimator.sinks.home_assistant.entities import cell_key, entities

MAX_ROWS = 18
"""Maximum number of published values of default-enabled entities in a minute. With two values of alarms, the recorder
writes at most 20 rows a minute."""
MINUTE_S = 60.0
"""Length of the window for ``MAX_ROWS`` [s]."""
MESSAGE_INTERVAL_S = 5.0
"""Minimum interval between two messages with values [s]."""
HEARTBEAT_S = 10.0
"""Interval at which unchanged values are repeated, so that they do not expire [s]."""


class EntityStates(NamedTuple):
    """Values published to Home Assistant. Times are on a monotonic clock [s]."""

    values: Mapping[str, float | None] = {}
    changed_s: Mapping[str, float] = {}
    published_s: float = -math.inf
    """Time of the last message."""
    rows_s: tuple[float, ...] = ()
    """Publish time of each value that was counted against ``MAX_ROWS`` in the last minute."""


def values_to_publish(
    shown: EntityStates, snapshot: Snapshot, discovery: DiscoveryInputs, now_s: float, *, sign: float = 1.0
) -> EntityStates:
    """Return the values to publish; ``shown`` itself if nothing changed enough.

    Args:
        shown: Values published last.
        snapshot: Snapshot with the current values.
        discovery: Data that determine the entities.
        now_s: Monotonic clock [s].
        sign: Factor of signed values; -1 if charging is positive.
    """
    elapsed_s = now_s - shown.published_s
    if snapshot.estimate is None or elapsed_s < MESSAGE_INTERVAL_S:
        return shown
    existing = entities(discovery.info, discovery.cells)
    values = _rounded(snapshot, existing, sign)
    changed = {key: value for key, value in values.items() if _is_due(shown, key, value, existing[key], now_s)}
    recent_s = tuple(at_s for at_s in shown.rows_s if now_s - at_s < MINUTE_S)
    # first values are not limited, because all entities get one at once
    rows = [key for key in changed if existing[key].enabled and key in shown.values]
    rows.sort(key=lambda key: shown.changed_s[key])
    for postponed in rows[MAX_ROWS - len(recent_s) :]:
        del changed[postponed]
    if not changed and elapsed_s < HEARTBEAT_S:
        return shown
    return shown._replace(
        values={**shown.values, **changed},
        changed_s={**shown.changed_s, **dict.fromkeys(changed, now_s)},
        published_s=now_s,
        rows_s=(*recent_s, *[now_s for key in rows if key in changed]),
    )


def _rounded(snapshot: Snapshot, existing: Mapping[str, Entity], sign: float) -> dict[str, float | None]:
    """Return the rounded value of each entity; None without a value."""
    values, rounded = _values(snapshot), dict[str, float | None]()
    for key, entity in existing.items():
        value = values.get(key)
        if value is not None and entity.signed:
            value *= sign
        # `or None` makes round() return an integer, `or 0` replaces -0.0
        rounded[key] = None if value is None else round(value, entity.decimals or None) or 0
    return rounded


def _values(snapshot: Snapshot) -> dict[str, float | None]:
    """Return all values of a snapshot by the keys of the entities."""
    estimate, parameters = snapshot.estimate, snapshot.parameters
    assert estimate is not None  # noqa: S101 - for the type checker: the caller has checked it
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


def _is_due(shown: EntityStates, key: str, value: float | None, entity: Entity, now_s: float) -> bool:
    """Return True if a value should be published again."""
    if key not in shown.values:
        return True
    before, interval_passed = shown.values[key], now_s - shown.changed_s[key] >= entity.min_interval_s
    if value is None or before is None:
        return interval_passed and value is not before
    min_change = entity.step if interval_passed else entity.immediate_step
    return round(abs(value - before), entity.decimals) >= min_change
