"""All alarms of a pack, evaluated from samples and estimates.

Alarms evaluate each sample, not the published means, and use the samples' clock. A replay therefore raises the same
alarms as the live run. Alarms use raw values, including glitches that the estimator drops. The delays suppress single glitches.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.forecast.available_power import NO_FORECAST, ForecastRows
from bms_estimator.kernels.alarms.records import CELLS, FAULTY_BOARD, LINK_LOST, NAMES
from bms_estimator.model.arrays import NO_CELLS, NO_PROBES, CellBlock, ProbeBlock, SampleBlock, SampleStatus
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarm_limits import STATE_LOST, monitored_alarms, silent_limit_s
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.alarm_list import AlarmList
from bms_estimator.telemetry.alarms.causes import WRONG_CLOCK_TEXT, ProbeFaults, find_unknown, time_left_text
from bms_estimator.telemetry.alarms.definitions import (
    MODEL_SUSPECTS,
    QUANTITIES,
    SENSOR_SUSPECTS,
    AlarmDefinitions,
    Change,
    decode,
    encode,
)
from bms_estimator.telemetry.cells import CellAlarmInputs
from bms_estimator.telemetry.health import suspicions

MIN_WATCHED_S = 10.0
"""Minimum time with samples before alarms count as watched [s]. The delays of most critical alarms are not longer."""
TEMPERATURE_ALARMS: frozenset[AlarmName] = frozenset(
    {"over_temperature", "under_temperature", "charging_below_freezing"}
)
"""Alarms that a missing probe can keep raised."""
_SUSPECTS: Mapping[AlarmName, InputFault] = {"sensor_fault": SENSOR_SUSPECTS, "model_mismatch": MODEL_SUSPECTS}
"""Input faults that raise an alarm, by alarm."""


class AlarmEvaluator:
    """Evaluator of all alarms of one pack.

    Args:
        settings: Settings of the pack.
        estimator: Estimator of the pack; read only.

    Raises:
        UserError: A clear level lies beyond its limit.
    """

    def __init__(self, settings: Settings, estimator: Estimator) -> None:
        model, gap_s = estimator.cell, float(estimator.settings["gap_s"][0])
        self._alarms = AlarmList(AlarmDefinitions.of(monitored_alarms(settings, model), settings, model, gap_s))
        self._estimator, self._probe_faults = estimator, ProbeFaults()
        self._lost_s, self._silence_limit_s = settings.alarms.lost_s, silent_limit_s(settings)
        self._silence_end_s = -math.inf  # end of the last silence on the monotonic clock [s]

    @property
    def is_watching(self) -> bool:
        """True if enough samples have arrived since the start or a silence, and no delay of a critical alarm runs.

        A relay may only then follow the alarms, because before that a due alarm may not be raised yet.
        """
        watched_s = float(self._alarms.kernel.io["watched_s"][0])  # NaN during a silence
        return watched_s >= max(self._lost_s, MIN_WATCHED_S) and not self._alarms.pending

    def evaluate(
        self,
        samples: SampleBlock,
        trace: TraceBlock,
        cells_v: CellBlock,
        arrival_s: float,
        *,
        forecasts: ForecastRows = NO_FORECAST,
        probes: ProbeBlock = NO_PROBES,
        cells_fault: str = "",
        clock_fault: str = "",
        conflict: str = "",
        lost: int = 0,
        cell_alarm_inputs: CellAlarmInputs | None = None,
        weak_cell_std: float = math.nan,
    ) -> None:
        """Evaluate all alarms on a block, after the estimator has processed it.

        Args:
            samples: Samples.
            trace: Their estimates.
            cells_v: Their cell voltages [V]; empty if there are none.
            arrival_s: Arrival of the last sample on the wall clock [s since 1970].
            forecasts: Forecast at each row of ``trace``.
            probes: Their temperature probes; empty if there are none.
            cells_fault: Reason why the cell voltages cannot be used; empty if they can.
            clock_fault: Fault of the source's clock as a sentence; empty without a fault.
            conflict: Description of a second publisher of the samples, a sentence; empty without one.
            lost: Number of samples since start that were lost on the line.
            cell_alarm_inputs: New faults of single cells; None without a new estimate.
            weak_cell_std: Deviation of the last discharge from the bank's reference [std]; NaN if unknown.
        """
        if not samples.size:
            return
        alarms, causes = self._alarms, self._alarms.causes
        samples, was_faulty = self._probe_faults.add(samples, probes), alarms.is_raised("sensor_fault")
        self._set_suspects()
        io, times_s = alarms.kernel.io, samples["time_s"]
        if cells_fault:
            causes.input_faults.add("cells", cells_fault, cells_fault)
        if conflict:
            # always the same kind, so that the first text stays although the values in it vary
            causes.input_faults.add("publishers", "two", conflict)
        io["cells_unusable"] = bool(cells_fault)
        alarms.record["faults"] |= (bool(cells_fault) << CELLS) | (bool(causes.board_fault) << FAULTY_BOARD)
        last_s = (
            times_s[-1] if math.isfinite(times_s[-1]) else np.append(alarms.at_s, times_s[np.isfinite(times_s)])[-1]
        )
        io["wall_offset_s"], io["lost"], io["weak_cell_std"] = arrival_s - last_s, lost, weak_cell_std
        io["cells_at_s"] = math.nan
        if cell_alarm_inputs:
            short, reading = cell_alarm_inputs.short, cell_alarm_inputs.reading
            io["cells_at_s"], io["short_a"], io["reading_v"] = cell_alarm_inputs.at_s, short.value, reading.value
            causes.set_cell_fault("cell_short", short, is_raised=alarms.is_raised("cell_short"))
            causes.set_cell_fault("cell_sensor_fault", reading, is_raised=alarms.is_raised("cell_sensor_fault"))
        risk = np.ascontiguousarray(forecasts["cutoff_within_5min"])
        alarms.kernel.run(alarms.record, alarms.definitions, self._estimator.record, samples, cells_v, trace, risk)
        self._describe_faults(samples, cells_v, clock_fault)
        if io["inputs_evaluated"][0]:
            causes.input_faults.end_interval(keep=was_faulty or alarms.is_raised("sensor_fault"))
        if trace.size:
            causes.unknown = find_unknown(trace[-1], soc_known=bool(alarms.record["soc_known"][0]))

        def reason_at(at_s: float) -> str:
            row = np.flatnonzero(trace["time_s"] == at_s)[-1]
            return time_left_text(forecasts[min(row, forecasts.size - 1)])

        alarms.take_changes(reason_at)

    def on_silence(self, silent_s: float, now_s: float, reason: str, monotonic_s: float) -> None:
        """Handle missing samples.

        Args:
            silent_s: Time since the last sample on the monotonic clock [s].
            now_s: Wall clock [s since 1970].
            reason: Reason for the silence; empty if unknown.
            monotonic_s: Monotonic clock [s].
        """
        alarms, is_silent = self._alarms, silent_s >= self._silence_limit_s
        if is_silent:
            alarms.kernel.io["watched_s"], self._silence_end_s = math.nan, monotonic_s
        elif alarms.silence_reason:
            # Due alarms are raised before the silence ends, so that a relay does not close in between. The first samples may
            # have waited in the buffers of a suspended process.
            is_silent = monotonic_s - self._silence_end_s < MIN_WATCHED_S or not self.is_watching
        if is_silent != bool(alarms.silence_reason):
            alarms.set_silence((reason or "no samples arrive") if is_silent else "")
        definition = alarms.definitions.by_position.get(LINK_LOST)
        if definition is None or silent_s < definition.limit:
            return
        alarms.states["cause_cleared"][LINK_LOST] = 0  # the cause of a latched alarm has returned
        if reason or not alarms.is_raised("link_lost"):  # a source may know the reason only after the alarm was raised
            alarms.causes.set_texts("link_lost", *([reason] if reason else []))
        alarms.raise_at("link_lost", now_s, silent_s)

    def evaluate_hooks(self, failing: Sequence[str], passed_s: float, now_s: float, *, is_undone: bool = False) -> None:
        """Evaluate the alarm ``hook_failed``.

        Args:
            failing: Hooks whose last run failed, each with its reason.
            passed_s: Time since the last call [s].
            now_s: Wall clock [s since 1970].
            is_undone: True if a reset of the board has undone a relay level. It raises the alarm without its delay.
        """
        alarms = self._alarms
        if failing:
            alarms.causes.set_texts("hook_failed", *failing)
        if is_undone:
            alarms.raise_at("hook_failed", now_s)
        value = math.inf if failing else 0.0  # this alarm publishes no value
        alarms.update("hook_failed", passed_s, value, now_s)

    def evaluate_resets(self, reason: str, now_s: float) -> None:
        """Raise ``sensor_fault`` without its delay while there is a reason.

        Args:
            reason: Reason why the board's resets are a fault; empty if they are not.
            now_s: Wall clock [s since 1970].
        """
        if reason == self._alarms.causes.board_fault:
            return
        self._alarms.causes.board_fault = reason
        if reason:
            self._alarms.raise_at("sensor_fault", now_s)

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Acknowledge an alarm, or all alarms. Return their names. Alarms whose cause is gone end now.

        Args:
            name: Name of the alarm; None: all.
        """
        acknowledged = self._alarms.acknowledge(name)
        if "sensor_fault" in acknowledged and TEMPERATURE_ALARMS.isdisjoint((*self.active, *self._alarms.pending)):
            self._probe_faults.expected = 0  # a missing probe was removed
        return acknowledged

    def names(self) -> tuple[AlarmName, ...]:
        """Return the names of all alarms."""
        return tuple(self._alarms.positions)

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
        """Return all alarms whose quantities were ever measured, and those that are raised, as ``AlarmList.report`` does."""
        return self._alarms.report()

    @property
    def saved_state(self) -> str:
        """State for ``restore`` after a restart, as JSON; empty if there is nothing to restore."""
        alarms = self._alarms
        return encode(
            alarms.record[0],
            alarms.definitions.by_position,
            pending=alarms.pending,
            silence_reason=alarms.silence_reason,
            probes=self._probe_faults.expected,
        )

    def restore(self, saved_state: str, crashed_s: float | None = None) -> str:
        """Restore the ``saved_state`` of an earlier run.

        Args:
            saved_state: The saved state.
            crashed_s: Wall clock [s since 1970] if the earlier run crashed or was killed, perhaps because the cause of an alarm
                cut its power. Alarms whose delay ran are then raised. None: it ended cleanly, and the delays resume.

        Returns:
            Reason why raised or due critical alarms are missing; empty if none are.

        Raises:
            ValueError, TypeError, LookupError, AttributeError, ArithmeticError, OSError: The saved state is damaged.
        """
        alarms = self._alarms
        saved = decode(saved_state, series=alarms.definitions.bounds.series)
        self._probe_faults.expected = saved.probes
        alarms.restore(saved)
        for name in saved.pending:
            if crashed_s is None:
                alarms.resume_delay(name)
            elif name in alarms.positions:
                alarms.raise_at(name, crashed_s)
        missing = [name for name in (*saved.raised_critical, *saved.pending) if name not in alarms.positions]
        return f"no longer monitored, but raised or due before the restart: {', '.join(missing)}" if missing else ""

    def raise_state_lost(self, reason: str, now_s: float, measured: Mapping[Quantity, int]) -> None:
        """Raise ``alarm_state_lost`` until it is acknowledged.

        Args:
            reason: Reason why raised alarms may be missing.
            now_s: Wall clock [s since 1970].
            measured: Number of values in a sample of the earlier run, by quantity. A quantity that does not arrive is lost.
        """
        alarms = self._alarms
        alarms.expect(measured)
        alarms.causes.set_texts(STATE_LOST.name, reason)
        alarms.raise_at(STATE_LOST.name, now_s)
        alarms.states["cause_cleared"][NAMES.index(STATE_LOST.name)] = 1  # an acknowledgement ends it at once

    def _set_suspects(self) -> None:
        """Update the causes of the alarms that input faults raise, if the filter suspects other faults than before."""
        record, alarms = self._estimator.record, self._alarms
        bits = int(record["checks"]["suspects"][0])
        if not (bits or alarms.causes.has_suspects):
            return
        suspects = InputFault(bits)

        def texts() -> Sequence[str]:
            return suspicions(record[0], self._estimator.settings_record[0])

        for name, faults in _SUSPECTS.items():
            alarms.causes.set_suspects(name, suspects & faults, texts, is_raised=alarms.is_raised(name))

    def _describe_faults(self, samples: SampleBlock, cells_v: CellBlock, clock_fault: str) -> None:
        """Describe faults of the clock, of probes and of impossible values in a block that the kernel has processed."""
        faults, alarms = self._alarms.causes.input_faults, self._alarms
        if int(np.bitwise_or.reduce(samples["status"])) & SampleStatus.WRONG_CLOCK:
            faults.add("time", "rate", clock_fault or WRONG_CLOCK_TEXT)
        if probe_fault := self._probe_faults.take():
            faults.add("temperature", "probe", probe_fault)
        for quantity, row in zip(QUANTITIES, alarms.kernel.io["impossible"][0].tolist(), strict=True):
            if row:  # one above the index of a sample; 0: no impossible value
                cells = cells_v[row - 1] if len(cells_v) == samples.size else NO_CELLS
                faults.add(quantity, *alarms.definitions.bounds.describe(quantity, samples[row - 1], cells))
