"""What Home Assistant is shown and when: a value that has moved and rested long enough, a problem when it comes or goes.

Entities of which each moves all the time make 20 rows a minute in all: three quick ones and eight slow ones.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from bms_estimator.model.estimate import Snapshot
from bms_estimator.sinks.home_assistant import SLOW_S, Entity, entities

PAUSE_S = 5.0
"""Between two messages with values [s]."""
HEARTBEAT_S = 10.0
"""Values that have not changed are said again, so that they do not expire [s]."""
LOCK_LOST = "the observer does not follow the measured voltage"


class Shown(NamedTuple):
    """What Home Assistant was told last. Times are on a monotonic clock [s]."""

    values: Mapping[str, float | None] = {}
    changed_s: Mapping[str, float] = {}
    told_s: float = -math.inf
    problems: Mapping[str, str | None] = {}
    problems_s: float = -math.inf


def next_values(shown: Shown, snapshot: Snapshot, now_s: float) -> Shown:
    """What to tell of the values; ``shown`` itself where nothing is to be told."""
    waited_s = now_s - shown.told_s
    if snapshot.estimate is None or waited_s < PAUSE_S:
        return shown
    shows = entities(snapshot.info)
    moved = {k: value for k, value in _rounded(snapshot, shows).items() if _moved(shown, k, value, shows[k], now_s)}
    if not moved and waited_s < HEARTBEAT_S:
        return shown
    return shown._replace(
        values={**shown.values, **moved},
        changed_s={**shown.changed_s, **dict.fromkeys(moved, now_s)},
        told_s=now_s,
    )


def next_problems(shown: Shown, snapshot: Snapshot, now_s: float) -> Shown:
    """What to tell of the problems; ``shown`` itself where nothing is to be told."""
    problems = _problems(shown, snapshot)
    if problems == shown.problems:
        return shown
    flipped = {key for key, reason in problems.items() if reason} != {k for k, r in shown.problems.items() if r}
    if not flipped and now_s - shown.problems_s < SLOW_S:  # only a count within a reason has changed
        return shown
    return shown._replace(problems=problems, problems_s=now_s)


def _rounded(snapshot: Snapshot, shows: Mapping[str, Entity]) -> dict[str, float | None]:
    """The value of each entity; None where there is none."""
    elements, rounded = snapshot.parameters.elements, dict[str, float | None]()
    for key, entity in shows.items():
        value = elements[key].value if key in elements else getattr(snapshot.estimate, key, None)
        rounded[key] = None if value is None else round(value, entity.decimals)
    return rounded


def _moved(shown: Shown, key: str, value: float | None, entity: Entity, now_s: float) -> bool:
    """Whether a value is to be shown anew."""
    if key not in shown.values:
        return True
    if now_s - shown.changed_s[key] < entity.pace_s:
        return False
    before = shown.values[key]
    if value is None or before is None:
        return value is not before
    return round(abs(value - before), entity.decimals) >= entity.step


def _problems(shown: Shown, snapshot: Snapshot) -> dict[str, str | None]:
    """Why, by problem; None where there is none."""
    lock_lost = shown.problems.get("lock_lost")
    if snapshot.estimate is not None:
        lock_lost = None if snapshot.estimate.lock else LOCK_LOST
    health = snapshot.health
    return {
        "sensor_silent": health.sensor_message,
        "suspicion": " ".join(health.suspects) or None,
        "lock_lost": lock_lost,
    }
