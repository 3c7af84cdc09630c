"""Time base of a table: the unit of a time column that states none, and the better of two time columns."""

import dataclasses

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.sources.captures.tables.cell_values import DATES, TIME_UNITS, CellKind, Unit, find_unit
from bms_estimator.sources.captures.tables.dialects import OWN
from bms_estimator.sources.captures.tables.layout import Column, Layout, RawBlock, Role, without_clock

FIRST_UNIX_S, LAST_UNIX_S = 9e8, 4e9
"""Range of Unix times in a capture: 1998 to 2096 [s]."""
MIN_BETTER_FRACTION = 0.1
"""Minimum decrease of the fraction of disordered times at which the second time column is chosen instead of the first one. A
disordered time is not later than all times before it."""
MAX_RATE_ERROR = 0.2
"""Maximum relative difference of the rates of two time columns that agree."""
DAY_S = 86_400.0
CHUNKS = 8
"""Number of parts of a table in which two time columns are compared. Their median excludes pauses of one of them."""
ROLLOVERS_S = {CellKind.DURATION: (DAY_S, 1800.0)} | dict.fromkeys(DATES, (3600.0, 600.0))
"""Size of the expected backward step, and maximum true time between the two rows around it [s]. Times of the day step back at
midnight, and dates at the end of summer time. With a longer true time, the clock was set or the test was restarted."""
MIN_STEP_RESTARTS, MIN_STEP_FRACTION, MIN_STEP_CHANGE = 2, 0.8, 0.05
"""For a time that starts again with each step: minimum number of its restarts, minimum fraction of them at which the current
changes, and minimum change relative to the range of the current."""
MIN_DESCENDING_FRACTION = 0.9
"""Minimum fraction of steps back in time, for a table whose newest row is the first one."""
FIRST_EXCEL_DAY, LAST_EXCEL_DAY = 36_526.0, 73_051.0
"""Days in the years 2000 to 2099 as spreadsheets count them."""
MAX_EXCEL_PERIOD_S = 3600.0
"""Maximum sample period of dates as numbers of days [s]."""
MIN_PERIOD_S, MAX_PERIOD_S = 0.005, 90.0
"""Range of the sample period [s]. With a period beyond it, the assumed unit is probably wrong."""


@dataclasses.dataclass(frozen=True)
class TimeBase:
    """Columns of a table with its decided time column.

    Attributes:
        layout: Columns without the second time column, unless it contains the dates of times of the day.
        role: Role of the column that is the time.
        reason: Reason for the column or for its unit, for messages; empty if the table states both.
        warning: Contradiction, with its remedy; empty without one.
        is_step_time: True if the time starts again with each step of a test.
    """

    layout: Layout
    role: Role = Role.TIME
    reason: str = ""
    warning: str = ""
    is_step_time: bool = False


def find_time_base(layout: Layout, raw: RawBlock) -> TimeBase:
    """Return the time base of a table.

    Args:
        layout: Columns of the table.
        raw: Rows at its beginning.
    """
    time, clock = layout.columns[Role.TIME], layout.columns.get(Role.CLOCK)
    if clock is not None and time.kind is CellKind.DURATION and _is_time_of_day(clock, raw):
        return TimeBase(layout, reason=f'after "{clock.name}"')
    time_base = _unix_time_base(layout, time, raw[Role.TIME]) or _spreadsheet_time_base(layout, time, raw[Role.TIME])
    if time_base is None and clock is not None and not clock.assumed:
        time_base = _clock_time_base(layout, time, clock, raw)
    if time_base is not None:
        return time_base
    warning = _implausible_period(time, raw[Role.TIME]) if time.assumed else ""
    is_step_time = layout.dialect is not OWN and _is_step_time(raw[Role.TIME], raw[Role.CURRENT])
    reason = "starts again with each step: the steps are joined" if is_step_time else ""
    return TimeBase(without_clock(layout), reason=reason, warning=warning, is_step_time=is_step_time)


def _is_step_time(values: Floats, current: Floats) -> bool:
    """Return True if a time restarts near 0 where the current changes. At a restart of the tester, the current does not change."""
    valid = np.isfinite(values) & np.isfinite(current)
    times, steps, changes = values[valid], np.diff(values[valid]), np.abs(np.diff(current[valid]))
    is_restart = steps < 0.0
    if np.count_nonzero(is_restart) < MIN_STEP_RESTARTS or not (steps > 0.0).any():
        return False
    is_change = changes[is_restart] > MIN_STEP_CHANGE * np.ptp(current[valid])
    near_0 = np.abs(times[1:][is_restart]) <= 2.0 * np.max(steps[steps > 0.0])
    return bool(near_0.all() and np.mean(is_change) >= MIN_STEP_FRACTION)


class ClockUnwrapper:
    """Continuation of times of the day across midnight, of dates across the end of summer time, and of the times of steps.

    Args:
        time: Column of the time. Other times as numbers are not changed.
        is_step_time: True if the time starts again with each step of a test.
    """

    def __init__(self, time: Column, *, is_step_time: bool) -> None:
        self._rollover_s, self._max_step_s = ROLLOVERS_S.get(time.kind, (0.0, 0.0))
        self._is_step_time = is_step_time
        self._last_s, self._added_s = np.nan, 0.0

    def apply(self, time_s: Floats) -> Floats:
        """Return the times of the next rows, without the backward steps of the clock [s]."""
        finite = np.flatnonzero(np.isfinite(time_s))
        if not (self._rollover_s or self._is_step_time) or not finite.size:
            return time_s
        values_s = time_s[finite]
        steps_s = np.diff(values_s, prepend=self._last_s)
        before_s = values_s - steps_s
        if self._is_step_time:
            rollovers_s = np.where(steps_s < 0.0, before_s, 0.0)
        else:
            can_roll_over = (before_s < DAY_S) | (self._rollover_s < DAY_S)
            is_rollover = (
                (-self._rollover_s < steps_s) & (steps_s <= self._max_step_s - self._rollover_s) & can_roll_over
            )
            rollovers_s = self._rollover_s * is_rollover
        self._last_s = float(values_s[-1])
        added_s = self._added_s + np.zeros(time_s.size)
        added_s[finite] += np.cumsum(rollovers_s)
        self._added_s = float(added_s[finite[-1]])
        return time_s + added_s


def is_descending(values: Floats) -> bool:
    """Return True if the newest row is the first one."""
    steps = np.diff(values[np.isfinite(values)])
    steps = steps[steps != 0.0]
    return bool(steps.size > 1 and np.mean(steps < 0.0) >= MIN_DESCENDING_FRACTION)


def _unix_time_base(layout: Layout, time: Column, values: Floats) -> TimeBase | None:
    """Return the time base of Unix times in another unit than seconds; None for other times."""
    unit = unix_unit(values)
    if unit is None or time.kind is not CellKind.NUMBER or unit == time.unit:
        return None
    if time.assumed:
        return TimeBase(_with_unit(layout, time, unit), reason="Unix time")
    warning = (
        f'the time "{time.name}" in {time.unit.symbol} is beyond the year 2096: if it is Unix time, use '
        f'--map "time={time.name} [{unit.symbol}]"'
    )
    return TimeBase(without_clock(layout), warning=warning)


def _spreadsheet_time_base(layout: Layout, time: Column, values: Floats) -> TimeBase | None:
    """Return the time base of dates that a spreadsheet has written as numbers of days; None for other times."""
    if time.kind is not CellKind.NUMBER or not time.assumed:
        return None
    finite = values[np.isfinite(values)]
    steps = np.abs(np.diff(finite))
    if not finite.size or not FIRST_EXCEL_DAY <= finite.min() <= finite.max() < LAST_EXCEL_DAY:
        return None
    if not 0.0 < (float(np.median(steps[steps > 0.0])) if steps.any() else 0.0) <= MAX_EXCEL_PERIOD_S / DAY_S:
        return None
    day = find_unit("time", "d")
    return TimeBase(_with_unit(layout, time, day), reason="days of a spreadsheet") if day else None


def _clock_time_base(layout: Layout, time: Column, clock: Column, raw: RawBlock) -> TimeBase | None:
    """Return the time base that a second time column shows; None if it shows nothing."""
    rate = _rate(raw[Role.CLOCK] * clock.unit.factor, raw[Role.TIME])
    if rate is None:
        return None
    disorder, clock_disorder = (_disorder_fraction(raw[role], raw[Role.CURRENT]) for role in (Role.TIME, Role.CLOCK))
    if clock_disorder < disorder - MIN_BETTER_FRACTION:
        with_clock = _with_time(layout, dataclasses.replace(clock, is_lenient=False))
        return TimeBase(with_clock, Role.CLOCK, f'"{time.name}" repeats times, or goes back')
    units = TIME_UNITS if time.assumed else (time.unit,)
    unit = next((unit for unit in units if abs(rate - unit.factor) <= MAX_RATE_ERROR * unit.factor), None)
    if unit is not None:
        return TimeBase(_with_unit(layout, time, unit), reason=f'by "{clock.name}"' if time.assumed else "")
    warning = (
        f'the time "{time.name}" in {time.unit.symbol} disagrees with "{clock.name}", which advances by {rate:.3g} s for '
        f'each unit: if so, use --map "time={clock.name}", or state the unit, as in --map "time={time.name} [min]"'
    )
    return TimeBase(without_clock(layout), warning=warning)


def _with_unit(layout: Layout, time: Column, unit: Unit) -> Layout:
    return _with_time(layout, dataclasses.replace(time, unit=unit, assumed=False))


def _with_time(layout: Layout, time: Column) -> Layout:
    return without_clock(dataclasses.replace(layout, columns={**layout.columns, Role.TIME: time}))


def _is_time_of_day(clock: Column, raw: RawBlock) -> bool:
    """Return True if the second column contains dates without a time, and the first one is not the time since the start."""
    valid = np.isfinite(raw[Role.CLOCK]) & np.isfinite(raw[Role.TIME])
    date_s, time_s = raw[Role.CLOCK][valid], raw[Role.TIME][valid]
    if clock.kind not in DATES or not date_s.size or (date_s % DAY_S).any() or time_s.max() >= DAY_S:
        return False
    later_days = np.diff(date_s) > 0.0
    return not later_days.any() or bool((np.diff(time_s)[later_days] < 0.0).any())


def unix_unit(values: Floats) -> Unit | None:
    """Return the unit in which large numbers are Unix times; None for smaller numbers."""
    finite = values[np.isfinite(values)]
    middle = float(np.median(finite)) if finite.size else 0.0
    units = (unit for unit in TIME_UNITS if unit.factor < 1.0)
    return next((unit for unit in units if FIRST_UNIX_S <= middle * unit.factor < LAST_UNIX_S), None)


def _rate(clock_s: Floats, values: Floats) -> float | None:
    """Return the seconds of a clock for each unit of the time column; None if the rows do not determine it."""
    valid = np.isfinite(clock_s) & np.isfinite(values)
    advance_s, advance = np.diff(clock_s[valid]), np.diff(values[valid])
    forward = (advance >= 0.0) & (advance_s >= 0.0)
    parts = [
        (part_s.sum(), part.sum())
        for part_s, part in zip(
            np.array_split(advance_s[forward], CHUNKS), np.array_split(advance[forward], CHUNKS), strict=True
        )
    ]
    rates = [part_s / part for part_s, part in parts if part > 0.0]
    rate = float(np.median(rates)) if rates else 0.0
    return rate if 0.0 < rate < np.inf else None


def _disorder_fraction(values: Floats, current: Floats) -> float:
    """Return the fraction of times that are not larger than all before. Cyclers repeat a time where the current changes."""
    valid = np.isfinite(values)
    times, latest, changes = (
        values[valid][1:],
        np.maximum.accumulate(values[valid])[:-1],
        np.diff(current[valid]) != 0.0,
    )
    return float(np.mean((times < latest) | ((times == latest) & ~changes))) if times.size else 1.0


def _implausible_period(time: Column, values: Floats) -> str:
    """Return a warning if the sample period is implausible in the assumed unit; otherwise an empty text."""
    steps = np.diff(values[np.isfinite(values)])
    period = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    if time.kind is not CellKind.NUMBER or MIN_PERIOD_S <= period <= MAX_PERIOD_S:
        return ""
    unit = "ms" if period > MAX_PERIOD_S else "h"
    return (
        f'the samples are {period:g} s apart if the time "{time.name}" is in s, which the file does not state: state the '
        f'unit, as in --map "time={time.name} [{unit}]"'
    )
