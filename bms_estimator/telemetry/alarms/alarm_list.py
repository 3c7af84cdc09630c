"""All alarms of a pack: their states, causes, payloads and changes.

An alarm cannot be watched if a quantity that it needs is no longer measured.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.alarm_kinds import ALARM_KINDS, Quantity
from bms_estimator.settings.alarm_limits import AlarmDefinition
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.inputs import Inputs
from bms_estimator.telemetry.alarms.message import AlarmMessage, Change, alarm_payload
from bms_estimator.telemetry.alarms.sensor_faults import FaultyInput
from bms_estimator.telemetry.alarms.state import AlarmState, AlarmTransition, RaisedAlarm

LOSS_TEXTS: dict[FaultyInput, str] = {
    "voltage": "the voltage is no longer measured",
    "current": "the current is no longer measured",
    "temperature": "the temperature is no longer measured",
    "cells": "cell voltages are missing that were measured before",
}
"""Description of the loss, by quantity."""


@dataclass(frozen=True)
class UnwatchedAlarms:
    """Alarms that cannot be watched.

    Attributes:
        reasons: Reason by alarm.
        loss_texts: Lost quantities, each with the alarms that need it, one sentence each.
    """

    reasons: dict[AlarmName, str] = field(default_factory=dict)
    loss_texts: tuple[str, ...] = ()


def find_unwatched(
    names: Iterable[AlarmName], inputs: Inputs, silence_reason: str, input_faults: Mapping[FaultyInput, str]
) -> UnwatchedAlarms:
    """Return the alarms that cannot be watched because of silence or the loss of a quantity.

    Args:
        names: Names of the defined alarms.
        inputs: State of the measured quantities.
        silence_reason: Reason why no samples arrive; empty while they arrive.
        input_faults: Description of each fault of the input, by quantity.
    """
    lost = inputs.lost
    texts = LOSS_TEXTS | dict(input_faults)
    reasons: dict[AlarmName, str] = {}
    for name in names:
        needed = ALARM_KINDS[name].needs
        missing = [texts[each] for each in needed if each in lost]
        if missing:
            reasons[name] = "; ".join(missing)
        elif silence_reason and needed and inputs.were_measured(needed):
            reasons[name] = silence_reason
    return UnwatchedAlarms(reasons, tuple(_loss_text(each, texts[each], reasons) for each in lost))


def _loss_text(quantity: Quantity, text: str, unwatched: Iterable[AlarmName]) -> str:
    """Describe a lost quantity and the unwatched alarms that need it."""
    names = ", ".join(name for name in unwatched if quantity in ALARM_KINDS[name].needs)
    return f"{text}: {names} cannot be raised" if names else text


ALWAYS_WATCHED: frozenset[AlarmName] = frozenset(("sensor_fault", "link_lost", "alarm_state_lost"))
"""Alarms that are watched even before the first sample."""


class Reasons(NamedTuple):
    """Causes of an alarm beyond its value."""

    suspects: InputFault
    """Input faults that the filter suspects."""
    texts: tuple[str, ...]
    """Causes, one sentence each."""


_NO_REASONS = Reasons(InputFault(0), ())


class AlarmList:
    """States of all alarms of one pack.

    Args:
        definitions: Definitions of the alarms.
        lost_s: Maximum time without values that counts toward a delay [s].

    Attributes:
        states: State by name.
        board_reason: Reason why the board's resets raise ``sensor_fault``; empty: none.
    """

    def __init__(self, definitions: Sequence[AlarmDefinition], lost_s: float) -> None:
        self.states = {each.name: AlarmState(each, lost_s=lost_s) for each in definitions}
        self.board_reason = ""
        self._unwatched = UnwatchedAlarms()
        self._unknown: Mapping[AlarmName, str] = {}
        self._input_faults: tuple[str, ...] = ()
        self._reasons: dict[AlarmName, Reasons] = {}
        self._changes: list[Change] = []
        self._unreported: dict[AlarmName, AlarmMessage] = {}
        self._payloads: dict[AlarmName, tuple[AlarmMessage, Alarm]] = {}  # rebuilt only when the message changes

    @property
    def active(self) -> tuple[AlarmName, ...]:
        """Names of all raised alarms."""
        return tuple(name for name, state in self.states.items() if state.raised is not None)

    @property
    def unwatched_critical(self) -> tuple[AlarmName, ...]:
        """Names of critical alarms that cannot be watched, because a quantity is lost or unusable."""
        return tuple(name for name in self._unwatched.reasons if self.states[name].definition.severity == "critical")

    @property
    def saved_state(self) -> dict[str, Any]:
        """Raised alarms for ``restore`` after a restart."""
        return {
            name: {
                **state.raised._asdict(),
                "gone": state.cause_cleared,
                "acknowledged": state.acknowledged,
                "severity": state.definition.severity,
            }
            for name, state in self.states.items()
            if state.raised is not None
        }

    @property
    def pending(self) -> list[AlarmName]:
        """Critical alarms whose delay runs."""
        return [
            name for name, each in self.states.items() if each.is_pending and each.definition.severity == "critical"
        ]

    def update(
        self,
        name: AlarmName,
        times_s: Floats,
        steps_s: Floats,
        values: Floats,
        wall_offset_s: float,
        reason_at: Callable[[float], str] | None = None,
        uncertain: NDArray[np.bool_] | None = None,
    ) -> None:
        """Process values of one alarm, if it is defined.

        Args:
            name: Name of the alarm.
            times_s: Times on the samples' clock [s], shape (n,).
            steps_s: Interval since the previous sample [s], 0 after a gap, shape (n,).
            values: Values in the unit of the limit, NaN if not measured, shape (n,).
            wall_offset_s: Wall clock minus the samples' clock [s].
            reason_at: Function that returns the cause of an alarm that was raised at a time on the samples' clock [s].
            uncertain: True where the true value may be beyond the limit, as in ``AlarmState.update``.
        """
        state = self.states.get(name)
        if state is None:
            return
        for transition in state.update(times_s, steps_s, values, wall_offset_s, uncertain):
            if transition.raised is not None and reason_at is not None:
                self.set_reasons(name, reason_at(transition.at_s))
            self._record(state, [transition])

    def raise_at(self, name: AlarmName, at_s: float, raised: RaisedAlarm) -> None:
        """Raise an alarm without its delay, if it is defined and not yet raised.

        Args:
            name: Name of the alarm.
            at_s: Time on the samples' clock [s].
            raised: Time on the wall clock, and value.
        """
        state = self.states.get(name)
        if state is not None:
            self._record(state, state.raise_at(at_s, raised))

    def acknowledge(self, name: AlarmName | None, at_s: float) -> list[AlarmName]:
        """Acknowledge an alarm, or all alarms. Return their names. Alarms whose cause is gone end now.

        Args:
            name: Name of the alarm; None: all.
            at_s: Time on the samples' clock [s].
        """
        raised = [state for key, state in self.states.items() if state.raised and name in (None, key)]
        for state in raised:
            if state.acknowledge():
                self._changes.append(Change(at_s, self._payload(state)))
        return [state.definition.name for state in raised]

    def set_reasons(self, name: AlarmName, *texts: str) -> None:
        """Replace the causes of an alarm, one sentence each."""
        self._reasons[name] = Reasons(InputFault(0), texts)

    def set_suspects(self, name: AlarmName, suspects: InputFault, suspicions: Sequence[str]) -> None:
        """Replace the causes of an alarm by the texts of suspected faults if their set has changed.

        The numbers in the texts may change each second and are therefore not compared.

        Args:
            name: Name of the alarm.
            suspects: Input faults that the filter suspects now and that raise this alarm.
            suspicions: All suspected faults, one sentence each.
        """
        state, before = self.states.get(name), self._reasons.get(name, _NO_REASONS)
        if state is not None and suspects != before.suspects and (suspects or state.raised is None):
            # each sentence ends in the text of its fault; numbers may precede this text
            texts = tuple(text for text in suspicions for suspect in suspects if text.endswith(suspect.text))
            self._reasons[name] = Reasons(suspects, texts)

    def set_input_faults(self, *texts: str) -> None:
        """Replace the faults of the input that ``sensor_fault`` describes, one sentence each."""
        self._input_faults = texts

    def set_unwatched(self, unwatched: UnwatchedAlarms, at_s: float) -> None:
        """Replace the alarms that cannot be watched, and record the changes at ``at_s`` on the samples' clock [s].

        A critical alarm whose delay runs stays unwatched, so that a relay does not close before the alarm is raised.
        """
        before, pending = self._unwatched.reasons, self.pending
        held = {name: reason for name, reason in before.items() if name in pending}
        self._unwatched = UnwatchedAlarms(held | unwatched.reasons, unwatched.loss_texts)
        for name in sorted(before.keys() ^ self._unwatched.reasons.keys()):
            self._changes.append(Change(at_s, self._payload(self.states[name]), "watched"))

    def set_unknown(self, reasons: Mapping[AlarmName, str]) -> None:
        """Replace the alarms whose value is not known, each with the reason."""
        self._unknown = reasons

    def changes(self) -> list[Change]:
        """Return the changes since the last call, oldest first."""
        changes, self._changes = self._changes, []
        return changes

    def report(self) -> tuple[Alarm, ...]:
        """Return all alarms that were ever watched, or whose value is not known.

        An alarm that was raised since the last call is reported as raised, even if it has ended.
        """
        unreported, self._unreported = self._unreported, {}
        return tuple(
            alarm_payload(state.definition, unreported[name])
            if state.raised is None and name in unreported
            else self._payload(state)
            for name, state in self.states.items()
            if state.has_value
            or state.raised is not None
            or name in self._unwatched.reasons
            or name in self._unknown
            or name in ALWAYS_WATCHED
        )

    def restore(self, saved: Mapping[AlarmName, Any], unwatched: UnwatchedAlarms) -> list[AlarmName]:
        """Restore the ``saved_state`` of an earlier run and the alarms that cannot be watched.

        Returns:
            Names of raised critical alarms that are not monitored, because of edited settings or of another version.

        Raises:
            ValueError, TypeError, LookupError: The saved state is damaged.
        """
        self._unwatched = unwatched
        for name, entry in saved.items():
            since_s, value, flags = float(entry["since_s"]), entry["value"], (entry["gone"], entry["acknowledged"])
            iso_utc(since_s)  # raises ValueError for a time that cannot be published
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name}: value = {value}")
            if not all(isinstance(flag, bool) for flag in flags):
                raise TypeError(f"{name}: gone, acknowledged = {flags}")
            if name in self.states:
                raised = RaisedAlarm(since_s, None if value is None else float(value))
                self.states[name].restore(raised, cause_cleared=flags[0], acknowledged=flags[1])
        missing = [name for name in saved if name not in self.states]
        # a former version saved no severity
        return [name for name in missing if saved[name].get("severity", "critical") == "critical"]

    def _record(self, state: AlarmState, transitions: Iterable[AlarmTransition]) -> None:
        """Record transitions for ``changes``, and raised alarms for ``report``."""
        for transition in transitions:
            message = self._message(state, transition.raised, cause_cleared=False)
            if transition.raised is not None:
                self._unreported[state.definition.name] = message
            self._changes.append(Change(transition.at_s, alarm_payload(state.definition, message)))

    def _payload(self, state: AlarmState) -> Alarm:
        """Return the payload of an alarm, cached until its message changes."""
        name = state.definition.name
        message = self._message(state, state.raised, cause_cleared=state.cause_cleared)
        latest = self._payloads.get(name)
        if latest is None or latest[0] != message:
            latest = self._payloads[name] = message, alarm_payload(state.definition, message)
        return latest[1]

    def _message(self, state: AlarmState, raised: RaisedAlarm | None, *, cause_cleared: bool) -> AlarmMessage:
        """Return the changing content of the payload of an alarm."""
        name = state.definition.name
        faults: tuple[str, ...] = ()
        if name == "sensor_fault":
            board = (self.board_reason,) if self.board_reason else ()
            faults = (*self._unwatched.loss_texts, *self._input_faults, *board)
        return AlarmMessage(
            raised,
            cause_cleared=cause_cleared,
            reasons=faults + self._reasons.get(name, _NO_REASONS).texts,
            unwatched_reason=self._unwatched.reasons.get(name),
            unknown_reason=self._unknown.get(name),
        )
