"""Selection of values for Home Assistant. A value is published if it has changed enough and its minimum interval has passed.

Home Assistant's recorder writes a row for each published value. Therefore this module limits the number of values a
minute. If more entities change, those published longest ago come first.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.model.quantity import Entity
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs
from bms_estimator.sinks.home_assistant.entities import cell_key, entities

MAX_ROWS_PER_MINUTE = 18
"""Maximum number of published values of default-enabled entities in a minute. With two values of alarms, the recorder
writes at most 20 rows a minute."""
MINUTE_S = 60.0
"""Length of the window for ``MAX_ROWS_PER_MINUTE`` [s]."""
MESSAGE_INTERVAL_S = 5.0
"""Minimum interval between two messages with values [s]."""
JOINT = ("voltage_v", "current_a", "power_w")
"""Values of one moment, which are published together."""
UNCERTAIN = (
    *("soc_percent", "remaining_capacity_ah", "remaining_energy_wh", "usable_capacity_ah"),
    *("usable_capacity_to_weakest_ah", "weakest_cell_soc", "time_to_full_h", "cutoff_within_15min_percent"),
    *("time_to_cutoff_h", "time_to_cutoff_p05_h", "time_to_cutoff_p95_h"),
)
"""Values that are unknown while the SOC is not known."""
HEARTBEAT_S = 10.0
"""Interval at which unchanged values are repeated, so that they do not expire [s]."""


class EntityStates(NamedTuple):
    """Values published to Home Assistant, by key of the entity. Times are on a monotonic clock [s]."""

    values: Mapping[str, float | None] = {}
    changed_s: Mapping[str, float] = {}
    """Time at which each value was published."""
    published_s: float = -math.inf
    """Time of the last message."""
    rows_s: tuple[float, ...] = ()
    """Publish time of each value that was counted against ``MAX_ROWS_PER_MINUTE`` in the last minute."""


def values_to_publish(
    published: EntityStates, snapshot: Snapshot, discovery: DiscoveryInputs, now_s: float, *, sign: float = 1.0
) -> EntityStates:
    """Return the values to publish; ``published`` itself if nothing changed enough.

    Args:
        published: Values published last.
        snapshot: Snapshot with the current values.
        discovery: Data that determine the entities.
        now_s: Monotonic clock [s].
        sign: Factor of signed values; -1 if charging is positive.
    """
    elapsed_s = now_s - published.published_s
    if snapshot.estimate is None or elapsed_s < MESSAGE_INTERVAL_S:
        return published
    entities_by_key = entities(discovery.info, discovery.cells)
    values = _round_values(snapshot, entities_by_key, sign)
    due = {key for key, value in values.items() if _is_due(published, key, value, entities_by_key[key], now_s)}
    changed = {key: value for key, value in values.items() if key in due or (key in JOINT and due & {*JOINT})}
    recent_s = tuple(at_s for at_s in published.rows_s if now_s - at_s < MINUTE_S)
    # first values are not limited, because all entities get one at once
    rows = [key for key in changed if entities_by_key[key].enabled and key in published.values]
    rows.sort(key=lambda key: published.changed_s[key])
    for postponed in rows[MAX_ROWS_PER_MINUTE - len(recent_s) :]:
        for key in JOINT if postponed in JOINT else (postponed,):
            changed.pop(key, None)
    if not changed and elapsed_s < HEARTBEAT_S:
        return published
    return published._replace(
        values={**published.values, **changed},
        changed_s={**published.changed_s, **dict.fromkeys(changed, now_s)},
        published_s=now_s,
        rows_s=(*recent_s, *[now_s for key in rows if key in changed]),
    )


def _round_values(snapshot: Snapshot, entities_by_key: Mapping[str, Entity], sign: float) -> dict[str, float | None]:
    """Return the rounded value of each entity; None without a value."""
    values, rounded = _values(snapshot), dict[str, float | None]()
    for key, entity in entities_by_key.items():
        value = values.get(key)
        if value is not None:
            value *= (sign if entity.signed else 1.0) * entity.factor
        # `or None` makes round() return an integer, `or 0` replaces -0.0
        rounded[key] = None if value is None else round(value, entity.decimals or None) or 0
    return rounded


def _values(snapshot: Snapshot) -> dict[str, float | None]:
    """Return all values of a snapshot by the keys of the entities."""
    estimate, parameters = snapshot.estimate, snapshot.parameters
    assert estimate is not None  # noqa: S101 - for the type checker: the caller has checked it
    health, resistance = parameters.state_of_health.get("capacity"), parameters.elements.get("r_s_ohm")
    values = {
        **vars(estimate),
        **{key: element.value for key, element in parameters.elements.items()},
        "soc_std_percent": _scale(100.0, estimate.soc_std),
        "r_s_mohm": _scale(1e3, resistance.value if resistance else None),
        "time_to_cutoff_h": _scale(1.0 / 3600.0, estimate.time_to_cutoff_s),
        "time_to_cutoff_p05_h": _scale(1.0 / 3600.0, estimate.time_to_cutoff_p05_s),
        "time_to_cutoff_p95_h": _scale(1.0 / 3600.0, estimate.time_to_cutoff_p95_s),
        "cutoff_within_15min_percent": _scale(100.0, estimate.cutoff_within_15min),
        "time_to_full_h": _scale(1.0 / 3600.0, estimate.time_to_full_s),
        "soh_percent": _scale(100.0, health.value if health and health.valid else None),
        "soh_std_percent": _scale(100.0, health.std if health and health.valid else None),
        **{cell_key(number): volts for number, volts in enumerate(estimate.cells_v or (), start=1)},
    }
    return values if estimate.soc_known or estimate.soc is None else values | dict.fromkeys(UNCERTAIN)


def _scale(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


def _is_due(published: EntityStates, key: str, value: float | None, entity: Entity, now_s: float) -> bool:
    """Return True if a value should be published again."""
    if key not in published.values:
        return True
    published_value, interval_passed = published.values[key], now_s - published.changed_s[key] >= entity.min_interval_s
    if value is None or published_value is None:
        return interval_passed and value is not published_value
    min_change = entity.step if interval_passed else entity.immediate_step
    return round(abs(value - published_value), entity.decimals) >= min_change
