"""All alarms of a pack, evaluated from samples and estimates.

Alarms evaluate each sample, not the published means, and use the samples' clock. A replay therefore raises the same
alarms as the live run. Alarms use raw values, including glitches that the estimator drops. The delays suppress single glitches.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import NO_FORECAST, ForecastRows
from bms_estimator.kernels.alarms import BROKEN_WIRE_V, MAX_SPACING_FRACTION
from bms_estimator.model.arrays import Floats
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.model.sample import NO_PROBES, CellBlock, ProbeBlock, SampleBlock, SampleStatus
from bms_estimator.settings.alarm_kinds import ALARM_KINDS, Quantity
from bms_estimator.settings.alarm_limits import STATE_LOST, AlarmDefinition
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.alarm_list import AlarmList, find_unwatched
from bms_estimator.telemetry.alarms.estimate_alarms import MODEL_SUSPECTS, CellAlarms, EstimateAlarms
from bms_estimator.telemetry.alarms.inputs import Inputs, count_values
from bms_estimator.telemetry.alarms.measured_values import (
    UNUSABLE,
    SampleBuffer,
    WireLimits,
    has_bit,
    measured_values,
    uncertain_values,
)
from bms_estimator.telemetry.alarms.message import Change
from bms_estimator.telemetry.alarms.sample_intervals import FaultyFraction, SampleCounts, SampleIntervals
from bms_estimator.telemetry.alarms.sensor_faults import FaultTexts, ProbeFaults
from bms_estimator.telemetry.alarms.state import RaisedAlarm
from bms_estimator.telemetry.cells import CellFaults
from bms_estimator.telemetry.impossible import PackBounds

SENSOR_SUSPECTS = (
    InputFault.SIGN_OF_CURRENT | InputFault.OFFSET | InputFault.OUTLIERS | InputFault.VOLTAGE | InputFault.CURRENT
)
"""Input faults that raise ``sensor_fault``."""
INPUTS = "inputs"
"""Key of the measured quantities in the saved state."""
SILENCE = "silence"
"""Key of the reason why no samples arrived, in the saved state."""
PENDING = "pending"
"""Key of the critical alarms whose delay runs, in the saved state."""
PROBES = "probes"
"""Key of the number of temperature probes, in the saved state. All keys but these four are names of alarms."""
MIN_WATCHED_S = 10.0
"""Minimum duration of the samples after which alarms count as watched [s]. The delays of most critical alarms are not longer."""
WRONG_CLOCK_TEXT = "the clock of the source runs at a wrong rate, and the arrival times are used instead"
"""Text of a wrong clock that is right again at the end of a recorded block."""
TEMPERATURE_ALARMS: frozenset[AlarmName] = frozenset(
    {"over_temperature", "under_temperature", "charging_below_freezing"}
)
"""Alarms that a missing probe may hold."""
_COLUMNS: dict[Quantity, str] = {"voltage": "voltage_v", "current": "current_a", "temperature": "temperature_c"}
"""Column of SAMPLE by quantity."""


class AlarmEvaluator:
    """Evaluator of all alarms of one pack.

    Args:
        definitions: Definitions of the alarms.
        charging_a: Minimum current into the pack that counts as charging [A].
        gap_s: Minimum length of a gap between samples [s].
        inputs: State of the measured quantities.
        silence_limit_s: Time without a sample after which no alarm is watched [s].
        bounds: Bounds of the possible values; None: every value is possible.

    Attributes:
        rows: Number of samples that wait for ``evaluate``.
        saved_state: State for ``restore`` after a restart, as JSON; empty if there is nothing to restore.
    """

    def __init__(
        self,
        definitions: Sequence[AlarmDefinition],
        charging_a: float,
        gap_s: float,
        inputs: Inputs,
        silence_limit_s: float,
        bounds: PackBounds | None = None,
    ) -> None:
        self._alarms = AlarmList(definitions, inputs.lost_s)
        self._charging_a = charging_a
        self._inputs, self._silence_limit_s = inputs, silence_limit_s
        self._bounds, self._input_faults, self._probe_faults = bounds, FaultTexts(), ProbeFaults()
        self._silence_reason = ""  # reason why no samples arrive; empty while they do
        self._silence_s = -math.inf  # end of the last silence on the monotonic clock [s]
        self._watched_s: float | None = (
            None  # duration of the samples since the start or the last silence, without gaps
        )
        self._sample_intervals = SampleIntervals(gap_s)
        self._estimates, self._cells = EstimateAlarms(self._alarms, charging_a, gap_s), CellAlarms(self._alarms)
        self._buffer = SampleBuffer()
        self._faulty_fraction = FaultyFraction()
        self._at_s = 0.0  # time of the last sample
        self._faulty_s = -math.inf  # time of the last sample with a fault of the input
        self.saved_state = ""

    @property
    def is_watching(self) -> bool:
        """True if enough samples have arrived since the start or a silence, and no delay of a critical alarm runs.

        A relay may only then follow the alarms, because before that a due alarm may not be raised yet.
        """
        return (self._watched_s or 0.0) >= max(self._inputs.lost_s, MIN_WATCHED_S) and not self._alarms.pending

    @property
    def rows(self) -> int:
        """Number of samples that wait for ``evaluate``."""
        return self._buffer.size

    def add(
        self,
        block: SampleBlock,
        trace: TraceBlock,
        cells: CellBlock,
        forecasts: ForecastRows = NO_FORECAST,
        cells_fault: str = "",
        probes: ProbeBlock = NO_PROBES,
    ) -> None:
        """Buffer a block of samples for ``evaluate``.

        Args:
            block: Samples.
            trace: Their estimates.
            cells: Their cell voltages [V]; empty without any.
            forecasts: Forecast at each row of ``trace``.
            cells_fault: Reason why the cell voltages cannot be used; empty if they can.
            probes: Their temperature probes; empty without any.
        """
        block = self._probe_faults.add(block, probes)
        self._buffer.add(block, trace, cells, forecasts, cells_usable=not cells_fault)
        if cells_fault:
            self._input_faults.add("cells", cells_fault, cells_fault)

    def evaluate(
        self,
        arrival_s: float,
        counts: SampleCounts,
        suspects: InputFault,
        suspicions: Sequence[str],
        clock_fault: str = "",
    ) -> None:
        """Evaluate all buffered samples.

        Args:
            arrival_s: Arrival of the last buffered sample on the wall clock [s since 1970].
            counts: Numbers of samples since start.
            suspects: Input faults that the filter suspects now.
            suspicions: The suspected faults, one sentence each.
            clock_fault: Fault of the source's clock as a sentence; empty without one.
        """
        if not self.rows:
            return
        samples, trace, forecasts, cells = self._buffer.take()
        if (samples["status"] & SampleStatus.WRONG_CLOCK).any():
            self._input_faults.add("time", "rate", clock_fault or WRONG_CLOCK_TEXT)
        if probe_fault := self._probe_faults.take():
            self._input_faults.add("temperature", "probe", probe_fault)
        self._alarms.set_suspects("sensor_fault", suspects & SENSOR_SUSPECTS, suspicions)
        self._alarms.set_suspects("model_mismatch", suspects & MODEL_SUSPECTS, suspicions)
        if samples.size:
            wall_offset_s = arrival_s - float(samples["time_s"][-1])
            self._evaluate_samples(samples, cells, wall_offset_s)
            self._evaluate_faulty_fraction(float(samples["time_s"][-1]), counts, suspects, wall_offset_s)
        if trace.size:
            self._estimates.evaluate(trace, forecasts, suspects, arrival_s - float(trace["time_s"][-1]))
        self._save_state()

    def on_silence(self, silent_s: float, now_s: float, reason: str, steady_s: float) -> None:
        """Handle missing samples.

        Args:
            silent_s: Time since the last sample on the monotonic clock [s].
            now_s: Wall clock [s since 1970].
            reason: Reason for the silence; empty if unknown.
            steady_s: Monotonic clock [s].
        """
        is_silent = silent_s >= self._silence_limit_s
        if is_silent:
            self._watched_s, self._silence_s = None, steady_s
        elif self._silence_reason:  # alarms are raised before it ends, so that a relay does not close in between
            # the first samples may have waited in the buffers of a suspended process
            is_silent = steady_s - self._silence_s < MIN_WATCHED_S or not self.is_watching
        if is_silent != bool(self._silence_reason):
            self._silence_reason = (reason or "no samples arrive") if is_silent else ""
            self._update_unwatched(self._at_s)
            self._save_state()
        state = self._alarms.states.get("link_lost")
        if state is None or silent_s < state.definition.limit:
            return
        if state.cause_cleared:  # the cause of a latched alarm has returned
            state.cause_cleared = False
            self._save_state()
        if state.raised is None:
            self._alarms.set_reasons("link_lost", *([reason] if reason else []))
            self._alarms.raise_at("link_lost", self._at_s, RaisedAlarm(now_s, silent_s))
            self._save_state()

    def evaluate_hooks(self, failing: Sequence[str], passed_s: float, now_s: float, *, is_undone: bool = False) -> None:
        """Evaluate the alarm ``hook_failed``.

        Args:
            failing: Hooks whose last run failed, each with its reason.
            passed_s: Time since the last call [s].
            now_s: Wall clock [s since 1970].
            is_undone: True if a reset of the board has undone a relay level. It raises the alarm without its delay.
        """
        if failing:
            self._alarms.set_reasons("hook_failed", *failing)
        if is_undone:
            self._alarms.raise_at("hook_failed", self._at_s, RaisedAlarm(now_s, None))
        value = np.array([math.inf if failing else 0.0])  # this alarm publishes no value
        self._alarms.update("hook_failed", np.array([self._at_s]), np.array([passed_s]), value, now_s - self._at_s)
        self._save_state()

    def evaluate_resets(self, reason: str, now_s: float) -> None:
        """Raise ``sensor_fault`` without its delay while there is a reason.

        Args:
            reason: Reason why the board's resets are a fault; empty: they are none.
            now_s: Wall clock [s since 1970].
        """
        if reason == self._alarms.board_reason:
            return
        self._alarms.board_reason = reason
        if reason:
            self._alarms.raise_at("sensor_fault", self._at_s, RaisedAlarm(now_s, None))
            self._save_state()

    def evaluate_weak_cell(self, deviation_std: float, arrival_s: float) -> None:
        """Evaluate the alarm ``weak_cell`` at the last sample.

        Args:
            deviation_std: Deviation of the last discharge from the bank's reference [std]; NaN if unknown.
            arrival_s: Arrival of the last sample on the wall clock [s since 1970].
        """
        if not math.isnan(deviation_std):
            self._cells.evaluate_weak_cell(deviation_std, self._at_s, arrival_s - self._at_s)
            self._save_state()

    def evaluate_cells(self, faults: CellFaults, arrival_s: float) -> None:
        """Evaluate the alarms on faults of single cells.

        Args:
            faults: Faults at the last sample.
            arrival_s: Arrival of this sample on the wall clock [s since 1970].
        """
        self._cells.evaluate(faults, arrival_s - faults.at_s)
        self._save_state()

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Acknowledge an alarm, or all alarms. Return their names. Alarms whose cause is gone end now.

        Args:
            name: Name of the alarm; None: all.
        """
        acknowledged = self._alarms.acknowledge(name, self._at_s)
        if "sensor_fault" in acknowledged and TEMPERATURE_ALARMS.isdisjoint((*self.active, *self._alarms.pending)):
            self._probe_faults.expected = 0  # a missing probe was removed
        self._save_state()
        return acknowledged

    def names(self) -> tuple[AlarmName, ...]:
        """Return the names of all alarms."""
        return tuple(self._alarms.states)

    @property
    def active(self) -> tuple[AlarmName, ...]:
        """Names of all raised alarms."""
        return self._alarms.active

    @property
    def unwatched_critical(self) -> tuple[AlarmName, ...]:
        """Names of critical alarms that cannot be watched although their quantities were measured before."""
        return self._alarms.unwatched_critical

    def changes(self) -> list[Change]:
        """Return the changes since the last call, oldest first."""
        return self._alarms.changes()

    def report(self) -> tuple[Alarm, ...]:
        """Return all alarms that were ever watched.

        An alarm that was raised since the last call is reported as raised, even if it has ended.
        """
        return self._alarms.report()

    def restore(self, saved_state: str, crashed_s: float | None = None) -> str:
        """Restore the ``saved_state`` of an earlier run.

        Args:
            saved_state: The saved state.
            crashed_s: Wall clock [s since 1970] if the earlier run crashed or was killed, perhaps because the cause of an alarm
                cut its power. Alarms whose delay ran are then raised. None: it ended cleanly, and the delays resume.

        Returns:
            Reason for which raised or due critical alarms are missing; empty if none are.

        Raises:
            ValueError, TypeError, LookupError, AttributeError, ArithmeticError, OSError: The saved state is damaged.
        """
        text = json.dumps(json.loads(saved_state or "{}"), ensure_ascii=False)
        entries = json.loads(text.encode(errors="replace"))  # half of a UTF-16 pair could not be published
        self._inputs.restore(entries.pop(INPUTS, {}))
        self._silence_reason = str(entries.pop(SILENCE, ""))
        self._probe_faults.expected = int(entries.pop(PROBES, 0))
        pending = list(entries.pop(PENDING, []))
        unwatched = find_unwatched(self.names(), self._inputs, self._silence_reason, {})
        missing = self._alarms.restore(entries, unwatched)
        missing += [name for name in pending if name not in self._alarms.states]
        for name in pending:
            if crashed_s is not None:
                self._alarms.raise_at(name, self._at_s, RaisedAlarm(crashed_s, None))
            elif state := self._alarms.states.get(name):
                state.resume_delay()
        self._save_state()
        return f"no longer monitored, but raised or due before the restart: {', '.join(missing)}" if missing else ""

    def raise_state_lost(self, reason: str, now_s: float, measured: Mapping[Quantity, int]) -> None:
        """Raise ``alarm_state_lost`` until it is acknowledged.

        Args:
            reason: Reason for which raised alarms may be missing.
            now_s: Wall clock [s since 1970].
            measured: Number of values in a sample of the earlier run, by quantity. One that does not arrive is lost.
        """
        self._inputs.expect(measured)
        self._alarms.set_reasons(STATE_LOST.name, reason)
        self._alarms.raise_at(STATE_LOST.name, self._at_s, RaisedAlarm(now_s, None))
        self._alarms.states[STATE_LOST.name].cause_cleared = True  # an acknowledgement ends it at once
        self._save_state()

    def _evaluate_samples(self, samples: SampleBlock, cells: Floats, wall_offset_s: float) -> None:
        """Evaluate the alarms on measured values.

        Args:
            samples: Shape (n,), dtype SAMPLE.
            cells: Minimum, maximum [V], number and mean [V] of the cell voltages, shape (n, 4).
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        times_s = samples["time_s"]
        self._at_s = float(times_s[-1])
        passed_s, observed_s = self._sample_intervals.measure(times_s)
        # the interval before the first sample is a part of the silence
        self._watched_s = float(observed_s[1:].sum() if self._watched_s is None else self._watched_s + observed_s.sum())
        samples, cells, unusable = self._without_impossible(samples, cells)
        uncertain = uncertain_values(samples, cells, self._inputs.cells, self._wire_limits())
        for name, series in measured_values(samples, cells, self._charging_a).items():
            self._alarms.update(name, times_s, observed_s, series, wall_offset_s, uncertain=uncertain.get(name))
        gaps_s = np.where(observed_s < passed_s, passed_s, 0.0)  # duration of the gap before each sample [s]; 0: no gap
        self._alarms.update("link_lost", times_s, passed_s, gaps_s, wall_offset_s)
        counts = {name: count_values(samples[column]) for name, column in _COLUMNS.items()}
        counts["cells"] = cells[:, 2].astype(np.int64)
        # with only faulty probes the temperature counts as missing also if it was never measured
        unusable["temperature"] = has_bit(samples, SampleStatus.PROBE_FAULT) & np.isnan(samples["temperature_c"])
        unusable["current"] = has_bit(samples, SampleStatus.CURRENT_SATURATED) | unusable.get("current", False)
        is_wire_broken = samples["voltage_v"] < BROKEN_WIRE_V * self._inputs.series
        is_saturated = has_bit(samples, SampleStatus.VOLTAGE_SATURATED)
        unusable["voltage"] = is_wire_broken | is_saturated | unusable.get("voltage", False)
        for quantity, rows in unusable.items():
            counts[quantity][rows] = UNUSABLE
        if self.unwatched_critical:  # the delay of one that waited for it may have ended
            self._update_unwatched(self._at_s)
        for at_s in self._inputs.update(times_s, observed_s, counts):
            self._update_unwatched(at_s)
            if self._is_blinded():  # without the delay of the alarm, because a quantity has been missing for ``lost_s``
                self._alarms.raise_at("sensor_fault", at_s, RaisedAlarm(at_s + wall_offset_s, None))

    def _wire_limits(self) -> WireLimits:
        """Return the voltages that show a broken wire beside an alarm of the opposite side."""
        limits_v = {name: state.definition.limit for name, state in self._alarms.states.items()}
        broken_v = BROKEN_WIRE_V * self._inputs.series
        return WireLimits(
            limits_v.get("pack_under_voltage", broken_v),
            limits_v.get("cell_under_voltage", BROKEN_WIRE_V),
            limits_v.get("cell_over_voltage", math.inf),
        )

    def _without_impossible(
        self, samples: SampleBlock, cells: Floats
    ) -> tuple[SampleBlock, Floats, dict[Quantity, NDArray[np.bool_]]]:
        """Return samples and cells with NaN in place of impossible values, and the rows of these values by quantity."""
        found = self._bounds.find(samples, cells) if self._bounds else {}
        if found:
            samples, cells = samples.copy(), cells.copy()
        for quantity, each in found.items():
            self._input_faults.add(quantity, each.kind, each.text)
            if quantity == "cells":
                cells[each.rows, :2] = np.nan
            else:
                samples[_COLUMNS[quantity]][each.rows] = np.nan
        return samples, cells, {quantity: each.rows for quantity, each in found.items()}

    def _update_unwatched(self, at_s: float) -> None:
        """Update the alarms that cannot be watched at ``at_s`` on the samples' clock [s]."""
        unwatched = find_unwatched(self.names(), self._inputs, self._silence_reason, self._input_faults.texts)
        self._set_input_faults()
        self._alarms.set_unwatched(unwatched, at_s)

    def _set_input_faults(self) -> None:
        texts = self._input_faults.texts.items()
        self._alarms.set_input_faults(*(text for name, text in texts if name not in self._inputs.lost))

    def _is_blinded(self) -> bool:
        """Return True if a quantity is lost that a critical alarm needs."""
        lost = set(self._inputs.lost)
        return any(not lost.isdisjoint(ALARM_KINDS[name].needs) for name in self.unwatched_critical)

    def _evaluate_faulty_fraction(
        self, at_s: float, counts: SampleCounts, suspects: InputFault, wall_offset_s: float
    ) -> None:
        """Evaluate the fraction of samples that are lost or unusable."""
        if (fraction := self._faulty_fraction.update(at_s, counts)) is None:
            return
        observed_s, value = fraction
        state = self._alarms.states.get("sensor_fault")
        has_fault = self._input_faults.update(keep=state is not None and state.raised is not None)
        self._set_input_faults()
        if suspects & SENSOR_SUSPECTS or has_fault or self._is_blinded() or self._alarms.board_reason:
            value, self._faulty_s = math.inf, at_s  # above every limit
        elif at_s - self._faulty_s <= MAX_SPACING_FRACTION * self._inputs.lost_s and state and state.raised is None:
            value = math.nan  # a sample without a fault does not restart the delay of an intermittent one
        self._alarms.update("sensor_fault", np.array([at_s]), observed_s, np.array([value]), wall_offset_s)

    def _save_state(self) -> None:
        """Update ``saved_state``. With it, a relay that an alarm has opened stays open over a restart."""
        saved: dict[str, Any] = self._alarms.saved_state
        if inputs := self._inputs.saved_state:
            saved[INPUTS] = inputs
        if self._silence_reason:
            saved[SILENCE] = self._silence_reason
        if pending := self._alarms.pending:
            saved[PENDING] = pending
        if self._probe_faults.expected > 1:
            saved[PROBES] = self._probe_faults.expected
        self.saved_state = json.dumps(saved) if saved else ""
