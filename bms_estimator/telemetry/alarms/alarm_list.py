"""All alarms of a pack: their states, payloads and changes."""

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.alarms.evaluate import raise_alarm, update_alarm
from bms_estimator.kernels.alarms.quantities import lost_quantities, update_unwatched
from bms_estimator.kernels.alarms.records import ALARMS, COLLAPSE_RISK, NAMES, RAISED, WATCH_CHANGED, acknowledge
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.causes import Causes
from bms_estimator.telemetry.alarms.definitions import (
    QUANTITIES,
    AlarmDefinitions,
    AlarmMessage,
    Change,
    EvaluationKernel,
    RaisedAlarm,
    SavedState,
    alarm_payload,
)

ALWAYS_WATCHED: frozenset[AlarmName] = frozenset(("sensor_fault", "link_lost", "alarm_state_lost"))
"""Alarms that are watched even before the first sample."""
NO_VALUE = "no value yet"
"""Reason for an unknown value of an alarm whose quantities are measured, for example before a bank has a reference."""


class AlarmList:
    """All alarms of one pack. An alarm cannot be watched if a quantity that it needs is no longer measured.

    Args:
        definitions: Definitions of the alarms.

    Attributes:
        record: State of the alarms, shape (1,), dtype ``ALARMS``.
        states: States of the alarms by position, dtype ``ALARM``; a view.
        kernel: Kernel that updates ``record``.
        causes: Causes of the alarms.
        positions: Position of each monitored alarm.
        silence_reason: Reason why no samples arrive; empty while they arrive. ``set_silence`` changes it.
    """

    def __init__(self, definitions: AlarmDefinitions) -> None:
        self.definitions, self.kernel, self.causes = definitions, EvaluationKernel(), Causes()
        self.positions = {each.name: k for k, each in definitions.by_position.items()}
        self.record: NDArray[np.void] = np.zeros(1, ALARMS)
        self.states: NDArray[np.void] = self.record["states"][0]
        self.silence_reason = ""
        self._changes: list[Change] = []
        self._unreported: dict[AlarmName, AlarmMessage] = {}
        self._payloads: dict[AlarmName, tuple[AlarmMessage, Alarm]] = {}  # rebuilt only when the message changes

    @property
    def at_s(self) -> float:
        """Time of the last sample [s]; 0 before the first."""
        return float(self.record["samples"]["last_s"][0])

    @property
    def active(self) -> tuple[AlarmName, ...]:
        """Names of all raised alarms."""
        return self._names_where(self.states["raised"] != 0)

    @property
    def pending(self) -> tuple[AlarmName, ...]:
        """Names of the critical alarms whose delay runs."""
        return self._names_where((self.states["raised"] == 0) & (self.states["holds"] != 0) & self._is_critical)

    @property
    def unwatched_critical(self) -> tuple[AlarmName, ...]:
        """Names of critical alarms that cannot be watched although their quantities were measured before."""
        return self._names_where((self.states["unwatched"] != 0) & self._is_critical)

    def is_raised(self, name: AlarmName) -> bool:
        """Return True if an alarm is raised."""
        return bool(self.states["raised"][NAMES.index(name)])

    def raise_at(self, name: AlarmName, since_s: float, value: float = math.nan) -> None:
        """Raise an alarm at the last sample without its delay, if it is monitored and not yet raised.

        Args:
            name: Name of the alarm.
            since_s: Wall clock [s since 1970].
            value: Value in the unit of the alarm; NaN without a number.
        """
        kernel = self.kernel
        raise_alarm(self.record, self.definitions.limits, kernel.io, kernel.log, NAMES.index(name), since_s, value)
        self.take_changes()

    def update(self, name: AlarmName, passed_s: float, value: float, now_s: float) -> None:
        """Process a value of an alarm that no sample contains.

        Args:
            name: Name of the alarm.
            passed_s: Time since the last value [s].
            value: Value in the unit of the alarm.
            now_s: Wall clock [s since 1970].
        """
        kernel, limits, settings = self.kernel, self.definitions.limits, self.definitions.settings
        kernel.io["wall_offset_s"] = now_s - self.at_s
        k = NAMES.index(name)
        update_alarm(self.record, limits, settings, kernel.io, kernel.log, k, self.at_s, passed_s, value)
        self.take_changes()

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Acknowledge an alarm; None: all. Return the acknowledged ones. Alarms whose cause is gone end now."""
        acknowledged = [each for each in self.active if name in (None, each)]
        for each in acknowledged:
            acknowledge(self.record, self.kernel.io, self.kernel.log, self.positions[each], self.at_s)
        self.take_changes()
        return acknowledged

    def set_silence(self, reason: str) -> None:
        """Change ``silence_reason``, and with it the alarms that cannot be watched."""
        self.silence_reason, self.kernel.io["is_silent"] = reason, bool(reason)
        update_unwatched(self.record, self.definitions.limits, self.kernel.io, self.kernel.log, self.at_s)
        self.take_changes()

    def take_changes(self, reason_at: Callable[[float], str] = lambda _: "") -> None:
        """Take the changes from the log of the kernel.

        Args:
            reason_at: Returns the cause of ``collapse_risk`` from the time of its raise on the samples' clock [s].
        """
        has_reasons = False
        for k, kind, at_s, since_s, value in self.kernel.entries.tolist():
            definition = self.definitions.by_position[k]
            if kind == WATCH_CHANGED:
                if not has_reasons:
                    self._set_unwatched_reasons()
                    has_reasons = True
                self._changes.append(Change(at_s, self._payload(k), "watched"))
                continue
            raised = _raised_alarm(since_s, value) if kind == RAISED else None
            if raised and k == COLLAPSE_RISK:
                self.causes.set_texts("collapse_risk", reason_at(at_s))
            message = self.causes.message(definition.name, raised, cause_cleared=False)
            if raised:
                self._unreported[definition.name] = message
            self._changes.append(Change(at_s, alarm_payload(definition, message)))
        self.kernel.clear()
        if self.causes.unwatched:  # the reason may have changed
            self._set_unwatched_reasons()

    def changes(self) -> list[Change]:
        """Return the changes since the last call, oldest first."""
        changes, self._changes = self._changes, []
        return changes

    def report(self) -> tuple[Alarm, ...]:
        """Return the raised alarms, and all whose quantities were ever measured. Only the latter can become unwatched.

        An alarm that was raised since the last call is reported as raised, even if it has ended. An alarm without a value is
        reported as well, so that receivers learn that it is watched again, also after an outage of an earlier run.
        """
        unreported, self._unreported = self._unreported, {}
        states, raised = self.states, self.states["raised"].tolist()
        max_counts = self.record["quantities"]["max_count"][0] * self.record["samples"]["started"][0]
        measured = {QUANTITIES[q] for q in np.flatnonzero(max_counts)}
        is_reported = (states["has_value"] | states["raised"] | states["unwatched"]).tolist()
        return tuple(
            alarm_payload(definition, unreported[definition.name])
            if definition.name in unreported and not raised[k]
            else self._payload(k)
            for k, definition in self.definitions.by_position.items()
            if is_reported[k]
            or definition.name in ALWAYS_WATCHED
            or (definition.kind.needs and measured.issuperset(definition.kind.needs))
        )

    def restore(self, saved: SavedState) -> None:
        """Restore raised alarms, measured quantities and silence of an earlier run."""
        for name, (max_count, lost) in saved.counts.items():
            self.expect({name: max_count})
            self.record["quantities"]["lost"][0, QUANTITIES.index(name)] = lost
        self.set_silence(saved.silence_reason)
        self._changes.clear()
        for alarm in saved.raised.keys() & self.positions.keys():
            for field, value in saved.raised[alarm].items():
                self.states[field][self.positions[alarm]] = value

    def resume_delay(self, name: AlarmName) -> None:
        """Resume the delay of an earlier run. It counts as elapsed, so that a crash loop cannot prevent the alarm."""
        if name in self.positions and not self.is_raised(name):
            k = self.positions[name]
            self.states["holds"][k], self.states["held_s"][k] = 1, math.inf

    def expect(self, counts: Mapping[Quantity, int]) -> None:
        """Expect at least these numbers of values in a sample, because an earlier run measured them."""
        for name, count in counts.items():
            quantity = self.record["quantities"][0, QUANTITIES.index(name)]
            quantity["max_count"] = max(quantity["max_count"], count)

    @property
    def _is_critical(self) -> NDArray[np.bool_]:
        return np.asarray(self.definitions.limits["critical"] != 0)

    def _names_where(self, mask: NDArray[np.bool_]) -> tuple[AlarmName, ...]:
        is_true = mask.tolist()
        return tuple(name for name, k in self.positions.items() if is_true[k])

    def _set_unwatched_reasons(self) -> None:
        lost = lost_quantities(self.record[0])
        names = self._names_where(self.states["unwatched"] != 0)
        lost_names = tuple(name for q, name in enumerate(QUANTITIES) if lost >> q & 1)
        self.causes.set_unwatched(names, lost_names, self.silence_reason)

    def _payload(self, k: int) -> Alarm:
        """Return the payload of alarm ``k``, cached until its message changes."""
        definition, state = self.definitions.by_position[k], self.states[k]
        raised, cause_cleared = None, False
        if state["raised"]:
            raised, cause_cleared = _raised_alarm(*state[["since_s", "value"]].item()), bool(state["cause_cleared"])
        message = self.causes.message(definition.name, raised, cause_cleared=cause_cleared)
        if definition.kind.needs and not (raised or state["has_value"]):
            message = message._replace(unknown_reason=message.unknown_reason or NO_VALUE)
        latest = self._payloads.get(definition.name)
        if latest is None or latest[0] != message:
            latest = self._payloads[definition.name] = message, alarm_payload(definition, message)
        return latest[1]


def _raised_alarm(since_s: float, value: float) -> RaisedAlarm:
    """Return time and value of a raised alarm. ``value`` is NaN without a number."""
    return RaisedAlarm(since_s, None if math.isnan(value) else value)
