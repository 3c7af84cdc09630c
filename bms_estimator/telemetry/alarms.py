"""All alarms of a pack: from samples and estimates to raised alarms.

Each sample is judged, not the means that are published, and on the samples' own clock: a replay raises the same. Raw
values count, including those that the estimator drops as glitches; the delays keep single ones out.
"""

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.model.arrays import Floats
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads import Alarm
from bms_estimator.model.sample import CellBlock, SampleBlock, SampleStatus
from bms_estimator.settings.alarm_limits import NEEDED, AlarmDefinition, Quantity
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarm_inputs import LOST, Inputs, counted
from bms_estimator.telemetry.alarm_samples import Steps, Waiting
from bms_estimator.telemetry.alarm_state import AlarmState, AlarmTransition, RaisedAlarm
from bms_estimator.telemetry.alarm_text import alarm_text

SENSOR_SUSPECTS = (
    InputFault.SIGN_OF_CURRENT | InputFault.OFFSET | InputFault.OUTLIERS | InputFault.VOLTAGE | InputFault.CURRENT
)
MODEL_SUSPECTS = InputFault.CAPACITY | InputFault.OCV
ALWAYS: frozenset[AlarmName] = frozenset(("sensor_fault", "link_lost"))
"""Alarms that are monitored before anything was measured."""
INPUTS = "inputs"
"""Key of the saved state of measured quantities, beside the alarms' names."""
SILENCE = "silence"
"""Key of the saved reason why no samples arrived."""
SHARE_S = 1.0
"""Minimum time over which lost and unusable samples are compared with good ones [s]."""


class SampleCounts(NamedTuple):
    """Samples since start."""

    good: int
    bad: int
    """Lost on the line, damaged, or rejected by the estimator."""


class Change(NamedTuple):
    """An alarm was raised or ended, or can no longer or again be watched."""

    at_s: float
    """On the samples' clock [s]."""
    alarm: Alarm
    turn: Literal["active", "watched"] = "active"
    """Field of the alarm that has changed."""


class Reasons(NamedTuple):
    """Further facts about an alarm's cause."""

    suspects: InputFault
    texts: tuple[str, ...]


class AlarmMessage(NamedTuple):
    """Message about an alarm."""

    raising: RaisedAlarm | None
    gone: bool
    reasons: tuple[str, ...]
    unwatched: str | None
    """Why it is not watched; None while it is."""


_COLUMNS: dict[Quantity, str] = {"voltage": "voltage_v", "current": "current_a", "temperature": "temperature_c"}
"""Columns of a sample by quantity."""
_NO_REASONS = Reasons(InputFault(0), ())


class AlarmEvaluator:
    """The alarms of one pack.

    Args:
        watched: Definitions of the alarms.
        charging_a: Minimum current into the pack that counts as charging [A].
        gap_s: A time between samples that is shorter is no gap [s].
        inputs: Measured quantities.
        silent_s: Without a sample for this time no alarm is watched [s].

    Attributes:
        rows: Samples that wait to be judged.
        kept: State over a restart, for ``restore``.
    """

    def __init__(
        self, watched: Sequence[AlarmDefinition], charging_a: float, gap_s: float, inputs: Inputs, silent_s: float
    ) -> None:
        self._states = {each.name: AlarmState(each, lost_s=inputs.lost_s) for each in watched}
        self._charging_a = charging_a
        self._inputs, self._silent_s = inputs, silent_s
        self._silence = ""  # reason why no samples arrive; empty while they do
        self._has_samples = False  # since the start
        self._unwatched: dict[AlarmName, str] = {}  # reasons
        self._sampled, self._traced, self._shared = Steps(gap_s), Steps(gap_s), Steps(math.inf)
        self._waiting = Waiting()
        self._counts: SampleCounts | None = None
        self._counted_s = -math.inf
        self._at_s = 0.0  # of the last sample
        self._mismatch_suspected = False
        self._reasons: dict[AlarmName, Reasons] = {}
        self._changes: list[Change] = []
        self._unshown: dict[AlarmName, AlarmMessage] = {}
        self._payloads: dict[AlarmName, tuple[AlarmMessage, Alarm]] = {}  # rebuilt only when the message changes
        self.kept = ""

    @property
    def rows(self) -> int:
        """Samples that wait to be judged."""
        return self._waiting.size

    def add(self, block: SampleBlock, trace: TraceBlock, cells: CellBlock) -> None:
        """Take a block, its estimates, and its cell voltages; ``evaluate`` looks at them."""
        self._waiting.add(block, trace, cells)

    def evaluate(self, arrival_s: float, counts: SampleCounts, suspects: InputFault, suspicions: Sequence[str]) -> None:
        """Judge all that waits.

        Args:
            arrival_s: Wall clock at the arrival of the last of it [s since 1970].
            counts: Samples since start.
            suspects: What the identifier suspects now.
            suspicions: Suspicions as sentences.
        """
        if not self.rows:
            return
        self._has_samples = True
        samples, trace, extremes_v = self._waiting.take()
        self._suspect("sensor_fault", suspects & SENSOR_SUSPECTS, suspicions)
        self._suspect("model_mismatch", suspects & MODEL_SUSPECTS, suspicions)
        if samples.size:
            wall_s = arrival_s - float(samples["time_s"][-1])
            self._judge_samples(samples, extremes_v, wall_s)
            self._judge_share(float(samples["time_s"][-1]), counts, suspects, wall_s)
        if trace.size:
            self._judge_estimates(trace, suspects, arrival_s - float(trace["time_s"][-1]))
        self._save_state()

    def on_silence(self, silent_s: float, now_s: float, reason: str) -> None:
        """Handle missing samples.

        Args:
            silent_s: On the monotonic clock [s].
            now_s: Wall clock [s since 1970].
            reason: Why, as far as that is known.
        """
        goes_on = bool(self._silence) and not self._has_samples  # restored, and no sample has ended it
        if (silent_s >= self._silent_s or goes_on) != bool(self._silence):
            self._silence = "" if self._silence else reason or "no samples come"
            self._see(self._at_s)
            self._save_state()
        state = self._states.get("link_lost")
        if state is None or silent_s < state.watched.limit:
            return
        if state.cause_cleared:  # it latches, and is back
            state.cause_cleared = False
            self._save_state()
        if state.raising is None:
            self._reasons["link_lost"] = Reasons(InputFault(0), (reason,) if reason else ())
            self._note(state, state.raise_at(self._at_s, RaisedAlarm(now_s, silent_s)))
            self._save_state()

    def judge_hooks(self, failing: Sequence[str], passed_s: float, now_s: float) -> None:
        """Judge the alarm ``hook_failed``.

        Args:
            failing: Hooks whose last run failed, each with its reason.
            passed_s: Time since the last call [s].
            now_s: Wall clock [s since 1970].
        """
        if failing:
            self._reasons["hook_failed"] = Reasons(InputFault(0), tuple(failing))
        value = np.array([math.inf if failing else 0.0])  # this alarm publishes no value
        self._take("hook_failed", np.array([self._at_s]), np.array([passed_s]), value, now_s - self._at_s)
        self._save_state()

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Acknowledge an alarm, or all. Return the acknowledged ones; those whose cause has ended end now.

        Args:
            name: Name of the alarm; None: all.
        """
        found = [state for key, state in self._states.items() if state.raising and name in (None, key)]
        for state in found:
            if state.acknowledge():
                self._changes.append(Change(self._at_s, self._alarm(state)))
        self._save_state()
        return [state.watched.name for state in found]

    def names(self) -> tuple[AlarmName, ...]:
        """Names of all monitored alarms."""
        return tuple(self._states)

    @property
    def active(self) -> tuple[AlarmName, ...]:
        """Names of all raised alarms."""
        return tuple(name for name, state in self._states.items() if state.raising is not None)

    @property
    def unwatched(self) -> tuple[AlarmName, ...]:
        """Critical alarms that cannot be monitored although their quantity was measured before."""
        return tuple(name for name in self._unwatched if self._states[name].watched.severity == "critical")

    def changes(self) -> list[Change]:
        """Return the changes since the last call, oldest first."""
        changes, self._changes = self._changes, []
        return changes

    def report(self) -> tuple[Alarm, ...]:
        """All that are watched. An alarm raised since the last call is shown as raised, even if it has ended."""
        unshown, self._unshown = self._unshown, {}
        return tuple(
            _alarm(state.watched, unshown[name]) if state.raising is None and name in unshown else self._alarm(state)
            for name, state in self._states.items()
            if state.known or state.raising is not None or name in self._unwatched or name in ALWAYS
        )

    def restore(self, kept: str) -> None:
        """Continue from the ``kept`` state of an earlier run.

        Raises:
            ValueError, TypeError, LookupError: It is damaged.
        """
        entries = json.loads(kept or "{}")
        self._inputs.restore(entries.pop(INPUTS, {}))
        self._silence = str(entries.pop(SILENCE, ""))
        self._unwatched = self._reasons_unwatched()
        for name, told in entries.items():
            state = self._states.get(name)
            if state is None or (told["gone"] and not state.watched.latch):
                continue
            since_s, value = float(told["since_s"]), told["value"]
            iso_utc(since_s)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name}: value = {value}")
            raising = RaisedAlarm(since_s, None if value is None else float(value))
            state.restore(raising, gone=bool(told["gone"]), acknowledged=bool(told["acknowledged"]))
        self._save_state()

    def _judge_samples(self, samples: SampleBlock, extremes_v: Floats, wall_s: float) -> None:
        times_s, lowest_v, highest_v = samples["time_s"], extremes_v[:, 0], extremes_v[:, 1]
        self._at_s = float(times_s[-1])
        passed_s, seen_s = self._sampled.of(times_s)
        voltage_v, temperature_c = samples["voltage_v"], samples["temperature_c"]
        at_end = (samples["status"] & SampleStatus.CURRENT_SATURATED) != 0
        current_a = np.where(at_end, np.copysign(np.inf, samples["current_a"]), samples["current_a"])
        charged_c = np.where(current_a <= -self._charging_a, temperature_c, np.inf)
        charged_c[np.isnan(current_a) | np.isnan(temperature_c)] = np.nan
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
            "charging_below_freezing": charged_c,
        }
        for name, of in values.items():
            self._take(name, times_s, seen_s, of, wall_s)
        self._take("link_lost", times_s, passed_s, np.where(seen_s < passed_s, passed_s, 0.0), wall_s)
        counts = {name: counted(samples[column]) for name, column in _COLUMNS.items()}
        cells = extremes_v[:, 2].astype(np.int64)
        for at_s in self._inputs.take(times_s, seen_s, counts | {"cells": cells}):
            self._see(at_s)
            if self._is_blinded():
                self._raise_sensor_fault(at_s, wall_s)

    def _see(self, at_s: float) -> None:
        """Note which alarms can no longer or again be watched since ``at_s`` of the samples' clock [s]."""
        before, self._unwatched = self._unwatched, self._reasons_unwatched()
        for name in sorted(before.keys() ^ self._unwatched.keys()):
            self._changes.append(Change(at_s, self._alarm(self._states[name]), "watched"))

    def _reasons_unwatched(self) -> dict[AlarmName, str]:
        """Reasons by alarm: no sample arrives, or a required quantity is lost."""
        lost = self._inputs.lost
        found: dict[AlarmName, str] = {}
        for name in self._states:
            needed = NEEDED.get(name, ())
            missing = [LOST[each] for each in needed if each in lost]
            if missing:
                found[name] = "; ".join(missing)
            elif self._silence and needed and self._inputs.measured(needed):
                found[name] = self._silence
        return found

    def _is_blinded(self) -> bool:
        """Return True if a quantity is lost that a critical alarm needs."""
        lost = set(self._inputs.lost)
        return any(not lost.isdisjoint(NEEDED.get(name, ())) for name in self.unwatched)

    def _raise_sensor_fault(self, at_s: float, wall_s: float) -> None:
        """Raise it without its own delay: the quantity has been missing for ``lost_s`` already."""
        state = self._states.get("sensor_fault")
        if state is not None:
            self._note(state, state.raise_at(at_s, RaisedAlarm(at_s + wall_s, None)))

    def _judge_share(self, at_s: float, counts: SampleCounts, suspects: InputFault, wall_s: float) -> None:
        """Evaluate the share of samples that are lost or unusable."""
        if 0.0 <= at_s - self._counted_s < SHARE_S:
            return
        before, self._counts, self._counted_s = self._counts, counts, at_s
        _, seen_s = self._shared.of(np.array([at_s]))
        good, bad = (counts.good - before.good, counts.bad - before.bad) if before else (0, 0)
        share = bad / (good + bad) if good + bad > 0 else math.nan
        if suspects & SENSOR_SUSPECTS or self._is_blinded():
            share = math.inf
        self._take("sensor_fault", np.array([at_s]), seen_s, np.array([share]), wall_s)

    def _judge_estimates(self, trace: TraceBlock, suspects: InputFault, wall_s: float) -> None:
        times_s = trace["time_s"]
        _, seen_s = self._traced.of(times_s)
        soc, std = trace["soc"], trace["soc_std"]
        lost = (trace["lock"] == 0) | self._mismatch_suspected
        self._mismatch_suspected = bool(suspects & MODEL_SUSPECTS)
        lost[-1] |= self._mismatch_suspected  # start unknown: not before this
        values: dict[AlarmName, Floats] = {
            "soc_low": soc - np.where(np.isnan(std), 0.0, std),
            "stability_margin_low": trace["stability_margin"],
            "model_mismatch": np.where(lost, np.inf, np.abs(trace["innovation_v"])),
        }
        for name, of in values.items():
            self._take(name, times_s, seen_s, of, wall_s)

    def _take(self, name: AlarmName, times_s: Floats, steps_s: Floats, values: Floats, wall_s: float) -> None:
        state = self._states.get(name)
        if state is not None:
            self._note(state, state.take(times_s, steps_s, values, wall_s))

    def _note(self, state: AlarmState, turns: Iterable[AlarmTransition]) -> None:
        name = state.watched.name
        for turn in turns:
            told = AlarmMessage(
                turn.raising, gone=False, reasons=self._texts(name), unwatched=self._unwatched.get(name)
            )
            if turn.raising is not None:
                self._unshown[name] = told
            self._changes.append(Change(turn.at_s, _alarm(state.watched, told)))

    def _suspect(self, name: AlarmName, suspects: InputFault, suspicions: Sequence[str]) -> None:
        """Keep the sentences of the moment when a diagnostic began or ended: their numbers may change each second."""
        state, before = self._states.get(name), self._reasons.get(name, _NO_REASONS)
        if state is not None and suspects != before.suspects and (suspects or state.raising is None):
            texts = tuple(said for said in suspicions for suspect in suspects if said.endswith(suspect.text))
            self._reasons[name] = Reasons(suspects, texts)

    def _alarm(self, state: AlarmState) -> Alarm:
        name = state.watched.name
        message = AlarmMessage(
            state.raising, gone=state.cause_cleared, reasons=self._texts(name), unwatched=self._unwatched.get(name)
        )
        latest = self._payloads.get(name)
        if latest is None or latest[0] != message:
            latest = self._payloads[name] = message, _alarm(state.watched, message)
        return latest[1]

    def _texts(self, name: AlarmName) -> tuple[str, ...]:
        """Known causes of an alarm, one sentence each."""
        lost = tuple(self._lost_text(each) for each in self._inputs.lost) if name == "sensor_fault" else ()
        return lost + self._reasons.get(name, _NO_REASONS).texts

    def _lost_text(self, quantity: Quantity) -> str:
        """Describe a lost quantity and the alarms that need it."""
        names = ", ".join(name for name in self._unwatched if quantity in NEEDED.get(name, ()))
        return f"{LOST[quantity]}: {names} cannot be raised" if names else LOST[quantity]

    def _save_state(self) -> None:
        """Save the raised alarms, the lost quantities and the silence: a relay that has cut the load stays so over a restart."""
        kept: dict[str, Any] = {
            name: {**state.raising._asdict(), "gone": state.cause_cleared, "acknowledged": state.acknowledged}
            for name, state in self._states.items()
            if state.raising is not None
        }
        if inputs := self._inputs.kept:
            kept[INPUTS] = inputs
        if self._silence:
            kept[SILENCE] = self._silence
        self.kept = json.dumps(kept) if kept else ""


def _alarm(watched: AlarmDefinition, told: AlarmMessage) -> Alarm:
    raising, value = told.raising, told.raising.value if told.raising else None
    return Alarm(
        name=watched.name,
        severity=watched.severity,
        active=raising is not None,
        latched=told.gone,
        since=iso_utc(raising.since_s) if raising else None,
        value=value,
        limit=watched.limit,
        unit=watched.unit,
        text=alarm_text(watched, value, told.reasons, gone=told.gone) if raising else "",
        watched=told.unwatched is None,
        unwatched_reason=told.unwatched,
    )
