"""All alarms of a pack, evaluated from samples and estimates.

Alarms evaluate each sample, not the published means, and use the samples' clock. A replay therefore raises the alarms of
the live run. They use raw values, including glitches that the estimator drops. The delays suppress single glitches.
"""

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import ForecastRows, unknown_values
from bms_estimator.model.arrays import Floats
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.alarm import Alarm
from bms_estimator.model.sample import CellBlock, SampleBlock, SampleStatus
from bms_estimator.settings.alarm_kinds import ALARM_KINDS, Quantity
from bms_estimator.settings.alarm_limits import AlarmDefinition
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarm_inputs import LOSS_TEXTS, Inputs, count_values
from bms_estimator.telemetry.alarm_samples import SampleBuffer, SampleIntervals
from bms_estimator.telemetry.alarm_state import AlarmState, AlarmTransition, RaisedAlarm
from bms_estimator.telemetry.alarm_text import alarm_text
from bms_estimator.telemetry.cells import CellFault, CellFaults
from bms_estimator.telemetry.collapse_risk import collapse_risks, time_left_text

SENSOR_SUSPECTS = (
    InputFault.SIGN_OF_CURRENT | InputFault.OFFSET | InputFault.OUTLIERS | InputFault.VOLTAGE | InputFault.CURRENT
)
"""Input faults that raise ``sensor_fault``."""
MODEL_SUSPECTS = InputFault.CAPACITY | InputFault.OCV
"""Input faults that raise ``model_mismatch``."""
ALWAYS: frozenset[AlarmName] = frozenset(("sensor_fault", "link_lost"))
"""Alarms that are watched even before the first sample."""
INPUTS = "inputs"
"""Key of the measured quantities in the saved state. All other keys but ``SILENCE`` are names of alarms."""
SILENCE = "silence"
"""Key of the reason why no samples arrived, in the saved state."""
CELLS_GAP_S = 60.0
"""Minimum length of a gap between two evaluations of the single cells [s]."""
BAD_FRACTION_INTERVAL_S = 1.0
"""Minimum interval over which the fraction of lost and unusable samples is computed [s]."""

NO_FORECAST = unknown_values()
"""Forecast at all samples of a pack without a forecaster."""


class SampleCounts(NamedTuple):
    """Numbers of samples since start."""

    good: int
    """Samples that the estimator accepted."""
    bad: int
    """Samples that were lost on the line, damaged, or rejected by the estimator."""


class Change(NamedTuple):
    """Change of an alarm: raised, ended, no longer watched, or watched again."""

    at_s: float
    """Time on the samples' clock [s]."""
    alarm: Alarm
    field: Literal["active", "watched"] = "active"
    """Field of ``alarm`` that has changed."""


class Reasons(NamedTuple):
    """Causes of an alarm beyond its value."""

    suspects: InputFault
    """Input faults that the filter suspects."""
    texts: tuple[str, ...]
    """Causes, one sentence each."""


class AlarmMessage(NamedTuple):
    """Changing content of an alarm's payload."""

    raised: RaisedAlarm | None
    """Time and value of an active alarm; None if inactive."""
    cause_cleared: bool
    """True if the cause is gone but the alarm is latched."""
    reasons: tuple[str, ...]
    """Causes, one sentence each."""
    unwatched_reason: str | None
    """Reason why the alarm cannot be watched; None while it is watched."""


_COLUMNS: dict[Quantity, str] = {"voltage": "voltage_v", "current": "current_a", "temperature": "temperature_c"}
"""Column of SAMPLE by quantity."""
_NO_REASONS = Reasons(InputFault(0), ())


class AlarmEvaluator:
    """Evaluator of all alarms of one pack.

    Args:
        definitions: Definitions of the alarms.
        charging_a: Minimum current into the pack that counts as charging [A].
        gap_s: Minimum length of a gap between samples [s].
        inputs: State of the measured quantities.
        silence_limit_s: Time without a sample after which no alarm is watched [s].

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
    ) -> None:
        self._states = {each.name: AlarmState(each, lost_s=inputs.lost_s) for each in definitions}
        self._charging_a = charging_a
        self._inputs, self._silence_limit_s = inputs, silence_limit_s
        self._silence_reason = ""  # reason why no samples arrive; empty while they do
        self._has_samples = False  # since the start of this run
        self._unwatched_reasons: dict[AlarmName, str] = {}
        self._sample_intervals, self._trace_intervals = SampleIntervals(gap_s), SampleIntervals(gap_s)
        # no interval is a gap, because losses are counted in gaps, too, and a weak cell remains weak
        self._loss_intervals, self._weak_cell_intervals = SampleIntervals(math.inf), SampleIntervals(math.inf)
        self._cell_intervals = SampleIntervals(CELLS_GAP_S)
        self._cell_kinds = CellFault(0.0).kinds  # faulty readings in the text of their alarm
        self._buffer = SampleBuffer()
        self._counts: SampleCounts | None = None
        self._counted_s = -math.inf
        self._at_s = 0.0  # time of the last sample
        self._mismatch_suspected = False
        self._reasons: dict[AlarmName, Reasons] = {}
        self._changes: list[Change] = []
        self._unreported: dict[AlarmName, AlarmMessage] = {}
        self._payloads: dict[AlarmName, tuple[AlarmMessage, Alarm]] = {}  # rebuilt only when the message changes
        self.saved_state = ""

    @property
    def rows(self) -> int:
        """Number of samples that wait for ``evaluate``."""
        return self._buffer.size

    def add(
        self, block: SampleBlock, trace: TraceBlock, cells: CellBlock, forecasts: ForecastRows = NO_FORECAST
    ) -> None:
        """Buffer a block of samples, its estimates, its cell voltages and the forecast at each estimate for ``evaluate``."""
        self._buffer.add(block, trace, cells, forecasts)

    def evaluate(self, arrival_s: float, counts: SampleCounts, suspects: InputFault, suspicions: Sequence[str]) -> None:
        """Evaluate all buffered samples.

        Args:
            arrival_s: Arrival of the last buffered sample on the wall clock [s since 1970].
            counts: Numbers of samples since start.
            suspects: Input faults that the filter suspects now.
            suspicions: The suspected faults, one sentence each.
        """
        if not self.rows:
            return
        self._has_samples = True
        samples, trace, forecasts, extremes_v = self._buffer.take()
        self._update_reasons("sensor_fault", suspects & SENSOR_SUSPECTS, suspicions)
        self._update_reasons("model_mismatch", suspects & MODEL_SUSPECTS, suspicions)
        if samples.size:
            wall_offset_s = arrival_s - float(samples["time_s"][-1])
            self._evaluate_samples(samples, extremes_v, wall_offset_s)
            self._evaluate_bad_fraction(float(samples["time_s"][-1]), counts, suspects, wall_offset_s)
        if trace.size:
            self._evaluate_estimates(trace, forecasts, suspects, arrival_s - float(trace["time_s"][-1]))
        self._save_state()

    def on_silence(self, silent_s: float, now_s: float, reason: str) -> None:
        """Handle missing samples.

        Args:
            silent_s: Time since the last sample on the monotonic clock [s].
            now_s: Wall clock [s since 1970].
            reason: Reason for the silence; empty if unknown.
        """
        # a silence restored from an earlier run lasts until the first sample of this run
        is_restored = bool(self._silence_reason) and not self._has_samples
        if (silent_s >= self._silence_limit_s or is_restored) != bool(self._silence_reason):
            self._silence_reason = "" if self._silence_reason else reason or "no samples arrive"
            self._update_unwatched(self._at_s)
            self._save_state()
        state = self._states.get("link_lost")
        if state is None or silent_s < state.definition.limit:
            return
        if state.cause_cleared:  # the cause of a latched alarm has returned
            state.cause_cleared = False
            self._save_state()
        if state.raised is None:
            self._reasons["link_lost"] = Reasons(InputFault(0), (reason,) if reason else ())
            self._record(state, state.raise_at(self._at_s, RaisedAlarm(now_s, silent_s)))
            self._save_state()

    def evaluate_hooks(self, failing: Sequence[str], passed_s: float, now_s: float) -> None:
        """Evaluate the alarm ``hook_failed``.

        Args:
            failing: Hooks whose last run failed, each with its reason.
            passed_s: Time since the last call [s].
            now_s: Wall clock [s since 1970].
        """
        if failing:
            self._reasons["hook_failed"] = Reasons(InputFault(0), tuple(failing))
        value = np.array([math.inf if failing else 0.0])  # this alarm publishes no value
        self._evaluate_values("hook_failed", np.array([self._at_s]), np.array([passed_s]), value, now_s - self._at_s)
        self._save_state()

    def evaluate_weak_cell(self, deviation_std: float, arrival_s: float) -> None:
        """Evaluate the alarm ``weak_cell`` at the last sample.

        Args:
            deviation_std: Deviation of the last discharge from the bank's reference [std]; NaN if unknown.
            arrival_s: Arrival of the last sample on the wall clock [s since 1970].
        """
        if not math.isnan(deviation_std):
            time_s = np.array([self._at_s])
            _, observed_s = self._weak_cell_intervals.measure(time_s)
            self._evaluate_values("weak_cell", time_s, observed_s, np.array([deviation_std]), arrival_s - self._at_s)
            self._save_state()

    def evaluate_cells(self, faults: CellFaults, arrival_s: float) -> None:
        """Evaluate the alarms on faults of single cells.

        Args:
            faults: Faults at the last sample.
            arrival_s: Arrival of this sample on the wall clock [s since 1970].
        """
        times_s = np.array([faults.at_s])
        _, observed_s = self._cell_intervals.measure(times_s)
        values: dict[AlarmName, CellFault] = {"cell_short": faults.short, "cell_sensor_fault": faults.reading}
        for name, fault in values.items():
            state = self._states.get(name)
            # the text of a raised alarm changes only with the kinds of its faults, because its numbers change often
            if state is not None and (state.raised is None or (fault.kinds and fault.kinds != self._cell_kinds)):
                self._reasons[name], self._cell_kinds = Reasons(InputFault(0), fault.texts), fault.kinds
            self._evaluate_values(name, times_s, observed_s, np.array([fault.value]), arrival_s - faults.at_s)
        self._save_state()

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Acknowledge an alarm, or all alarms. Return their names. Alarms whose cause is gone end now.

        Args:
            name: Name of the alarm; None: all.
        """
        raised = [state for key, state in self._states.items() if state.raised and name in (None, key)]
        for state in raised:
            if state.acknowledge():
                self._changes.append(Change(self._at_s, self._alarm(state)))
        self._save_state()
        return [state.definition.name for state in raised]

    def names(self) -> tuple[AlarmName, ...]:
        """Return the names of all alarms."""
        return tuple(self._states)

    @property
    def active(self) -> tuple[AlarmName, ...]:
        """Names of all raised alarms."""
        return tuple(name for name, state in self._states.items() if state.raised is not None)

    @property
    def unwatched_critical(self) -> tuple[AlarmName, ...]:
        """Names of critical alarms that cannot be watched although their quantities were measured before."""
        return tuple(name for name in self._unwatched_reasons if self._states[name].definition.severity == "critical")

    def changes(self) -> list[Change]:
        """Return the changes since the last call, oldest first."""
        changes, self._changes = self._changes, []
        return changes

    def report(self) -> tuple[Alarm, ...]:
        """Return all alarms that were ever watched.

        An alarm that was raised since the last call is reported as raised, even if it has ended.
        """
        unreported, self._unreported = self._unreported, {}
        return tuple(
            _alarm(state.definition, unreported[name])
            if state.raised is None and name in unreported
            else self._alarm(state)
            for name, state in self._states.items()
            if state.has_value or state.raised is not None or name in self._unwatched_reasons or name in ALWAYS
        )

    def restore(self, saved_state: str) -> None:
        """Restore the ``saved_state`` of an earlier run.

        Raises:
            ValueError, TypeError, LookupError: The saved state is damaged.
        """
        entries = json.loads(saved_state or "{}")
        self._inputs.restore(entries.pop(INPUTS, {}))
        self._silence_reason = str(entries.pop(SILENCE, ""))
        self._unwatched_reasons = self._find_unwatched_reasons()
        for name, saved in entries.items():
            state = self._states.get(name)
            if state is None or (saved["gone"] and not state.definition.latch):
                continue
            since_s, value = float(saved["since_s"]), saved["value"]
            iso_utc(since_s)  # raises ValueError for a time that cannot be published
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name}: value = {value}")
            raised = RaisedAlarm(since_s, None if value is None else float(value))
            state.restore(raised, cause_cleared=bool(saved["gone"]), acknowledged=bool(saved["acknowledged"]))
        self._save_state()

    def _evaluate_samples(self, samples: SampleBlock, extremes_v: Floats, wall_offset_s: float) -> None:
        """Evaluate the alarms on measured values.

        Args:
            samples: Shape (n,), dtype SAMPLE.
            extremes_v: Minimum and maximum cell voltage [V] and number of cell voltages, shape (n, 3).
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        times_s, lowest_v, highest_v = samples["time_s"], extremes_v[:, 0], extremes_v[:, 1]
        self._at_s = float(times_s[-1])
        passed_s, observed_s = self._sample_intervals.measure(times_s)
        voltage_v, temperature_c = samples["voltage_v"], samples["temperature_c"]
        is_saturated = (samples["status"] & SampleStatus.CURRENT_SATURATED) != 0
        current_a = np.where(is_saturated, np.copysign(np.inf, samples["current_a"]), samples["current_a"])
        # the temperature while charging; infinite while not charging, NaN if a quantity is not measured
        charging_c = np.where(current_a <= -self._charging_a, temperature_c, np.inf)
        charging_c[np.isnan(current_a) | np.isnan(temperature_c)] = np.nan
        values: dict[AlarmName, Floats] = {
            "pack_over_voltage": voltage_v,
            "pack_under_voltage": voltage_v,
            "cell_over_voltage": highest_v,
            "cell_under_voltage": lowest_v,
            "cell_imbalance": highest_v - lowest_v,
            "discharge_over_current": current_a,
            "charge_over_current": -current_a,
            "over_temperature": temperature_c,
            "under_temperature": temperature_c,
            "charging_below_freezing": charging_c,
        }
        for name, series in values.items():
            self._evaluate_values(name, times_s, observed_s, series, wall_offset_s)
        gaps_s = np.where(observed_s < passed_s, passed_s, 0.0)  # values hold for less than the interval only in a gap
        self._evaluate_values("link_lost", times_s, passed_s, gaps_s, wall_offset_s)
        counts = {name: count_values(samples[column]) for name, column in _COLUMNS.items()}
        cells = extremes_v[:, 2].astype(np.int64)
        for at_s in self._inputs.update(times_s, observed_s, counts | {"cells": cells}):
            self._update_unwatched(at_s)
            if self._is_blinded():
                self._raise_sensor_fault(at_s, wall_offset_s)

    def _update_unwatched(self, at_s: float) -> None:
        """Update the alarms that cannot be watched at ``at_s`` on the samples' clock [s], and record the changes."""
        before, self._unwatched_reasons = self._unwatched_reasons, self._find_unwatched_reasons()
        for name in sorted(before.keys() ^ self._unwatched_reasons.keys()):
            self._changes.append(Change(at_s, self._alarm(self._states[name]), "watched"))

    def _find_unwatched_reasons(self) -> dict[AlarmName, str]:
        """Return the alarms that cannot be watched, each with its reason: silence, or the loss of a quantity."""
        lost = self._inputs.lost
        reasons: dict[AlarmName, str] = {}
        for name in self._states:
            needed = ALARM_KINDS[name].needs
            missing = [LOSS_TEXTS[each] for each in needed if each in lost]
            if missing:
                reasons[name] = "; ".join(missing)
            elif self._silence_reason and needed and self._inputs.were_measured(needed):
                reasons[name] = self._silence_reason
        return reasons

    def _is_blinded(self) -> bool:
        """Return True if a quantity is lost that a critical alarm needs."""
        lost = set(self._inputs.lost)
        return any(not lost.isdisjoint(ALARM_KINDS[name].needs) for name in self.unwatched_critical)

    def _raise_sensor_fault(self, at_s: float, wall_offset_s: float) -> None:
        """Raise ``sensor_fault`` without its delay, because the quantity has been missing for ``lost_s`` already."""
        state = self._states.get("sensor_fault")
        if state is not None:
            self._record(state, state.raise_at(at_s, RaisedAlarm(at_s + wall_offset_s, None)))

    def _evaluate_bad_fraction(
        self, at_s: float, counts: SampleCounts, suspects: InputFault, wall_offset_s: float
    ) -> None:
        """Evaluate the fraction of samples that are lost or unusable."""
        if 0.0 <= at_s - self._counted_s < BAD_FRACTION_INTERVAL_S:
            return
        before, self._counts, self._counted_s = self._counts, counts, at_s
        _, observed_s = self._loss_intervals.measure(np.array([at_s]))
        good, bad = (counts.good - before.good, counts.bad - before.bad) if before else (0, 0)
        bad_fraction = bad / (good + bad) if good + bad > 0 else math.nan
        if suspects & SENSOR_SUSPECTS or self._is_blinded():
            bad_fraction = math.inf  # above every limit
        self._evaluate_values("sensor_fault", np.array([at_s]), observed_s, np.array([bad_fraction]), wall_offset_s)

    def _evaluate_estimates(
        self, trace: TraceBlock, forecasts: ForecastRows, suspects: InputFault, wall_offset_s: float
    ) -> None:
        """Evaluate the alarms on estimates.

        Args:
            trace: Shape (n,), dtype TRACE.
            forecasts: Forecast at each row of the trace, shape (n,), dtype FORECAST.
            suspects: Input faults that the filter suspects now.
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        times_s = trace["time_s"]
        _, observed_s = self._trace_intervals.measure(times_s)
        soc, std = trace["soc"], trace["soc_std"]
        is_mismatch = (trace["lock"] == 0) | self._mismatch_suspected
        self._mismatch_suspected = bool(suspects & MODEL_SUSPECTS)
        # a new suspicion counts from the last sample on, because its start is unknown
        is_mismatch[-1] |= self._mismatch_suspected
        values: dict[AlarmName, Floats] = {
            "soc_low": soc - np.where(np.isnan(std), 0.0, std),
            "stability_margin_low": trace["stability_margin"],
            "model_mismatch": np.where(is_mismatch, np.inf, np.abs(trace["innovation_v"])),
        }
        for name, series in values.items():
            self._evaluate_values(name, times_s, observed_s, series, wall_offset_s)
        is_charging = trace["current_a"] <= -self._charging_a
        risks = collapse_risks(forecasts, is_charging)
        self._evaluate_values("collapse_risk", times_s, observed_s, risks, wall_offset_s, forecasts)

    def _evaluate_values(
        self,
        name: AlarmName,
        times_s: Floats,
        steps_s: Floats,
        values: Floats,
        wall_offset_s: float,
        forecasts: ForecastRows | None = None,
    ) -> None:
        """Evaluate one alarm, if it is defined.

        ``forecasts`` are the forecasts at ``times_s``, for the text of the alarm. The other arguments are those of
        ``AlarmState.update``.
        """
        state = self._states.get(name)
        if state is None:
            return
        for transition in state.update(times_s, steps_s, values, wall_offset_s):
            if transition.raised is not None and forecasts is not None:
                at = int(np.flatnonzero(times_s == transition.at_s)[-1])
                self._reasons[name] = Reasons(InputFault(0), (time_left_text(forecasts[at]),))
            self._record(state, [transition])

    def _record(self, state: AlarmState, transitions: Iterable[AlarmTransition]) -> None:
        """Record transitions for ``changes``, and raised alarms for ``report``."""
        name = state.definition.name
        for transition in transitions:
            message = AlarmMessage(
                transition.raised,
                cause_cleared=False,
                reasons=self._reason_texts(name),
                unwatched_reason=self._unwatched_reasons.get(name),
            )
            if transition.raised is not None:
                self._unreported[name] = message
            self._changes.append(Change(transition.at_s, _alarm(state.definition, message)))

    def _update_reasons(self, name: AlarmName, suspects: InputFault, suspicions: Sequence[str]) -> None:
        """Store the texts of suspected faults if their set has changed.

        The numbers in the texts may change each second and are therefore not compared.
        """
        state, before = self._states.get(name), self._reasons.get(name, _NO_REASONS)
        if state is not None and suspects != before.suspects and (suspects or state.raised is None):
            # a suspicion is the text of its fault, after numbers if there are any
            texts = tuple(text for text in suspicions for suspect in suspects if text.endswith(suspect.text))
            self._reasons[name] = Reasons(suspects, texts)

    def _alarm(self, state: AlarmState) -> Alarm:
        """Return the payload of an alarm, cached until its message changes."""
        name = state.definition.name
        message = AlarmMessage(
            state.raised,
            cause_cleared=state.cause_cleared,
            reasons=self._reason_texts(name),
            unwatched_reason=self._unwatched_reasons.get(name),
        )
        latest = self._payloads.get(name)
        if latest is None or latest[0] != message:
            latest = self._payloads[name] = message, _alarm(state.definition, message)
        return latest[1]

    def _reason_texts(self, name: AlarmName) -> tuple[str, ...]:
        """Return the known causes of an alarm, one sentence each."""
        lost = tuple(self._lost_text(each) for each in self._inputs.lost) if name == "sensor_fault" else ()
        return lost + self._reasons.get(name, _NO_REASONS).texts

    def _lost_text(self, quantity: Quantity) -> str:
        """Describe a lost quantity and the alarms that need it."""
        names = ", ".join(name for name in self._unwatched_reasons if quantity in ALARM_KINDS[name].needs)
        return f"{LOSS_TEXTS[quantity]}: {names} cannot be raised" if names else LOSS_TEXTS[quantity]

    def _save_state(self) -> None:
        """Update ``saved_state``, so that for example a relay that has cut the load stays open over a restart."""
        saved: dict[str, Any] = {
            name: {**state.raised._asdict(), "gone": state.cause_cleared, "acknowledged": state.acknowledged}
            for name, state in self._states.items()
            if state.raised is not None
        }
        if inputs := self._inputs.saved_state:
            saved[INPUTS] = inputs
        if self._silence_reason:
            saved[SILENCE] = self._silence_reason
        self.saved_state = json.dumps(saved) if saved else ""


def _alarm(definition: AlarmDefinition, message: AlarmMessage) -> Alarm:
    """Return the payload of an alarm."""
    raised, value = message.raised, message.raised.value if message.raised else None
    text = alarm_text(definition, value, message.reasons, cause_cleared=message.cause_cleared) if raised else ""
    return Alarm(
        name=definition.name,
        severity=definition.severity,
        active=raised is not None,
        latched=message.cause_cleared,
        since=iso_utc(raised.since_s) if raised else None,
        value=value,
        limit=definition.limit,
        unit=definition.kind.unit,
        text=text,
        watched=message.unwatched_reason is None,
        unwatched_reason=message.unwatched_reason,
    )
