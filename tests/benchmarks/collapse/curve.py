"""Curve of warnings against false alarms, by the state machine of the alarms of the service."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.settings.alarm_limits import AlarmDefinition
from bms_estimator.telemetry.alarms.state import AlarmState
from tests.benchmarks.collapse.signals import MAX_STEP_S, Discharge

SOON_S = 900.0
"""An alarm is false if no cut-off follows within this time [s]."""
AHEAD_S = 60.0
"""Minimum lead of a warning that leaves time to act [s]."""
DELAY_S, CLEAR_DELAY_S = 10.0, 60.0
"""Delays of the alarm [s]."""


@dataclass(frozen=True)
class Point:
    """Result of an alarm with one limit over all discharges.

    Attributes:
        limit: Limit of the signal.
        false_in_100_h: Number of false alarms in 100 h of use.
        raised: Fraction of the cut-offs before which the alarm was raised.
        ahead: Fraction of the cut-offs before which it was raised by at least ``AHEAD_S``.
        median_lead_s: Median lead of the raised alarms [s], at most ``SOON_S``; NaN without any.
    """

    limit: float
    false_in_100_h: float
    raised: float
    ahead: float
    median_lead_s: float


def curve(discharges: Sequence[Discharge], signals: Sequence[Floats], limits: Floats, clears: Floats) -> list[Point]:
    """Return one point for each limit.

    Args:
        discharges: Discharges.
        signals: Signal of each discharge, one value for each of its rows. NaN: unknown.
        limits: Levels at which the alarm is raised.
        clears: Level below which the alarm of each limit ends.
    """
    return [point(discharges, signals, float(limit), float(clear)) for limit, clear in zip(limits, clears, strict=True)]


def point(discharges: Sequence[Discharge], signals: Sequence[Floats], limit: float, clear: float) -> Point:
    """Return the result of one limit."""
    false, leads_s = 0, list[float]()
    for discharge, signal in zip(discharges, signals, strict=True):
        alarms = raised_alarms(discharge.rows["time_s"], signal, limit, clear)
        left_s = [discharge.cutoff_s - begin_s for begin_s, _ in alarms]  # NaN without a cut-off
        false += sum(not each_s <= SOON_S for each_s in left_s)
        # an alarm that was raised earlier and has not ended counts as a warning, too
        shortly_before_s = discharge.cutoff_s - SOON_S
        leads_s += [
            min(each_s, SOON_S) for each_s, (_, end_s) in zip(left_s, alarms, strict=True) if end_s >= shortly_before_s
        ][:1]
    cutoffs = sum(math.isfinite(each.cutoff_s) for each in discharges)
    ahead = sum(lead_s >= AHEAD_S for lead_s in leads_s)
    median_lead_s = float(np.median(leads_s)) if leads_s else math.nan
    hours = sum(each.use_h for each in discharges)
    return Point(limit, 100.0 * false / hours, len(leads_s) / cutoffs, ahead / cutoffs, median_lead_s)


def raised_alarms(times_s: Floats, signal: Floats, limit: float, clear: float) -> list[tuple[float, float]]:
    """Return begin and end of each alarm [s]; the end is infinite if the alarm is still raised at the last time."""
    definition = AlarmDefinition("collapse_risk", "warning", limit, clear, DELAY_S, CLEAR_DELAY_S, latch=False)
    steps_s = np.minimum(np.diff(times_s, prepend=times_s[0]), MAX_STEP_S)
    transitions = AlarmState(definition).update(times_s, steps_s, signal, 0.0)
    begins_s = [each.at_s for each in transitions if each.raised is not None]
    ends_s = [each.at_s for each in transitions if each.raised is None]
    return list(zip(begins_s, [*ends_s, math.inf], strict=False))


def best(points: Sequence[Point], max_false_in_100_h: float) -> Point | None:
    """Return the point with the most warnings ahead among those with at most this rate of false alarms; None without any."""
    accepted = [each for each in points if each.false_in_100_h <= max_false_in_100_h]
    return max(accepted, key=lambda each: (each.ahead, each.raised), default=None)
