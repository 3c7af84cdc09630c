"""Alarms and events of the pack whose record is loaded, evaluated with each block.

A worker has neither a link to the source nor hooks nor forecasts. Therefore it does not evaluate ``collapse_risk``,
``hook_failed`` and ``alarm_state_lost``, and raises ``link_lost`` for a gap when the next samples arrive. No alarm latches.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.fleet.packs.pack_type import PackType
from bms_estimator.fleet.worker.block_result import AlarmMessage
from bms_estimator.kernels.alarms.evaluate import begin_time_base, mark_reported
from bms_estimator.kernels.alarms.quantities import lost_quantities
from bms_estimator.kernels.alarms.records import COUNTS, ENDED, NAMES, RAISED, WATCH_CHANGED
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, CellBlock, SampleBlock, SampleStatus
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.events import Event, EventText, fit_event, input_fault_events, soc_events, watch_events
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.telemetry.alarms.causes import LOSS_TEXTS, PROBE_TEXT, WRONG_CLOCK_TEXT, find_unknown, suspect_texts
from bms_estimator.telemetry.alarms.definitions import (
    MODEL_SUSPECTS,
    QUANTITIES,
    SENSOR_SUSPECTS,
    AlarmMessage as AlarmContent,
    EvaluationKernel,
    RaisedAlarm,
    alarm_payload,
)
from bms_estimator.telemetry.cells import cell_alarm_inputs
from bms_estimator.telemetry.health import identifier_counters, last_anchor, last_change, suspicions


class PackAlarms:
    """Alarms and events of the pack whose record is loaded.

    Args:
        record: Unpacked record of the partition, shape (1,), dtype ``PACK_STATE``.
    """

    def __init__(self, record: NDArray[np.void]) -> None:
        self._alarms, self._estimator = record["alarms"], record["estimator"]
        self._states: NDArray[np.void] = self._alarms[0]["states"]
        self._evaluation = EvaluationKernel()
        self._samples: SampleBlock = np.zeros(0, SAMPLE)  # last samples of the block
        self._impossible: list[str] = []  # descriptions of impossible values in ``_samples``
        self._has_events = False  # True if the block has changed the estimator in a way that is an event
        self._cell_windows = self._fit_changes = (
            0  # numbers of cell estimates and of ``SlowFit.changes`` before the block
        )

    def begin_block(self, pack_type: PackType, *, is_new_time_base: bool) -> None:
        """Begin a block of the loaded pack.

        Args:
            pack_type: Type of the pack.
            is_new_time_base: True if the timestamps have another origin than those of the previous block.
        """
        if is_new_time_base:
            begin_time_base(self._alarms)
        self._evaluation.clear()
        self._has_events = False
        self._cell_windows = int(pack_type.cells.bank["windows"][0])
        self._fit_changes = pack_type.pack.slow_fit.changes if pack_type.pack.slow_fit else 0

    def add(
        self, pack_type: PackType, samples: SampleBlock, cells_v: CellBlock, trace: TraceBlock, wall_offset_s: float
    ) -> None:
        """Evaluate the alarms on samples and on their estimates, after the estimators have processed them.

        Args:
            pack_type: Type of the pack.
            samples: Samples, shape (n,), dtype SAMPLE.
            cells_v: Their cell voltages [V]; empty without any.
            trace: Their estimates.
            wall_offset_s: Wall clock of the edge minus the samples' clock [s].
        """
        io, slow_fit = self._evaluation.io[0], pack_type.pack.slow_fit
        io["wall_offset_s"], io["weak_cell_std"] = wall_offset_s, slow_fit.weak_cell_std if slow_fit else math.nan
        io["cells_at_s"], io["short_a"], io["reading_v"] = self._cell_values(pack_type)
        self._has_events |= self._evaluation.run(
            self._alarms, pack_type.alarms, self._estimator, samples, cells_v, trace
        )
        self._samples = samples
        self._impossible = [
            pack_type.alarms.bounds.describe(
                name, samples[row - 1], cells_v[row - 1] if len(cells_v) == samples.size else NO_CELLS
            )[1]
            for name, row in zip(QUANTITIES, io["impossible"].tolist(), strict=True)
            if row
        ]

    def _cell_values(self, pack_type: PackType) -> tuple[float, float, float]:
        """Return time [s], self-discharge [A] and error of the readings [V] of a new estimate of the cells; NaN without one."""
        cells, windows = pack_type.cells.deviations, int(pack_type.cells.bank["windows"][0])
        if cells is None or windows == self._cell_windows:
            return math.nan, math.nan, math.nan
        self._cell_windows = windows
        return cells.at_s, max(float(cells.proven_self_discharge_a.max()), 0.0), float(cells.reading_error_v.max())

    @property
    def is_soc_known(self) -> bool:
        """True if the SOC of the loaded pack was known at its last estimate."""
        return bool(self._alarms[0]["soc_known"])

    @property
    def raised(self) -> tuple[str, ...]:
        """Names of the raised alarms of the loaded pack."""
        return tuple(NAMES[k] for k in np.flatnonzero(self._states["raised"]))

    def messages(
        self, pack_type: PackType, trace: TraceBlock, now_s: float, *, include_unchanged: bool
    ) -> tuple[AlarmMessage, ...]:
        """Return the messages about the changes of the block, and its events.

        Args:
            pack_type: Type of the pack.
            trace: Last estimates of the block; empty without any.
            now_s: Wall clock [s since 1970].
            include_unchanged: True to include the raised and unwatched alarms that the block has not changed.
        """
        slow_fit = pack_type.pack.slow_fit
        entries = self._evaluation.entries
        has_fit_change = slow_fit and slow_fit.changes > self._fit_changes
        if not (entries.size or self._has_events or include_unchanged or has_fit_change):
            return ()
        positions = set(entries["alarm"].tolist())
        if include_unchanged:
            positions |= set(np.flatnonzero(self._states["raised"] | self._states["unwatched"]).tolist())
        positions &= pack_type.alarms.by_position.keys()
        about_alarms = (each for k in sorted(positions) for each in self._messages_of(k, pack_type, trace, now_s))
        return (*about_alarms, *(_event(text, now_s) for text in self._events(pack_type)))

    def _messages_of(self, k: int, pack_type: PackType, trace: TraceBlock, now_s: float) -> Iterator[AlarmMessage]:
        """Yield the events of alarm ``k`` in this block, and its state; two states if it was raised and has ended."""
        state, definition = self._states[k], pack_type.alarms.by_position[k]
        entries = self._evaluation.entries
        changes = {int(entry["kind"]): entry for entry in entries[entries["alarm"] == k]}  # the last one of each kind
        lost = lost_quantities(self._alarms[0])
        missing = [
            LOSS_TEXTS[name] for q, name in enumerate(QUANTITIES) if lost >> q & 1 and name in definition.kind.needs
        ]
        reasons = tuple(self._reasons(k, pack_type, lost))
        unknown = find_unknown(trace[-1], soc_known=self.is_soc_known) if trace.size else {}

        def payload(record: np.void, *, is_raised: bool) -> Alarm:
            value = float(record["value"])
            raised = RaisedAlarm(float(record["since_s"]), None if np.isnan(value) else value) if is_raised else None
            return alarm_payload(
                definition,
                AlarmContent(
                    raised,
                    cause_cleared=False,
                    reasons=reasons,
                    unwatched_reason=("; ".join(missing) or "its delay runs") if state["unwatched"] else None,
                    unknown_reason=unknown.get(definition.name),
                ),
            )

        is_raised = bool(state["raised"])
        if RAISED in changes:
            alarm = payload(changes[RAISED], is_raised=True)
            yield _event(EventText("alarm_raised", f"{alarm.name}: {alarm.text}"), now_s)
            if not is_raised:
                yield _message(alarm)
        if ENDED in changes:
            yield _event(EventText("alarm_cleared", definition.name), now_s)
        present = payload(state, is_raised=is_raised)
        if WATCH_CHANGED in changes:
            yield from (_event(text, now_s) for text in watch_events((present,)))
        yield _message(present)

    def _events(self, pack_type: PackType) -> Iterator[EventText]:
        """Yield the events since the last call, except those of alarms."""
        slow_fit, record = pack_type.pack.slow_fit, self._estimator[0]
        if slow_fit and slow_fit.changes > self._fit_changes and (change := last_change(slow_fit)):
            yield fit_event(change)
        reported = dict(zip(COUNTS.names or (), self._alarms[0]["reported"].item(), strict=True))
        former_faults = [fault.text for fault in InputFault(reported["suspects"])]
        yield from input_fault_events(former_faults, suspicions(record, pack_type.estimator.settings_record[0]))
        yield from soc_events(reported, identifier_counters(record), last_anchor(record))
        mark_reported(self._alarms, self._estimator)

    def _reasons(self, k: int, pack_type: PackType, lost: int) -> Iterator[str]:
        """Yield the causes of alarm ``k`` beyond its value, one sentence each."""
        name, cells = NAMES[k], pack_type.cells.deviations
        if name == "sensor_fault":
            yield from (LOSS_TEXTS[quantity] for q, quantity in enumerate(QUANTITIES) if lost >> q & 1)
            yield from self._input_faults()
        if cells is not None and name in ("cell_short", "cell_sensor_fault"):
            faults = cell_alarm_inputs(cells)
            yield from (faults.short if name == "cell_short" else faults.reading).texts
        kinds = {"sensor_fault": SENSOR_SUSPECTS, "model_mismatch": MODEL_SUSPECTS}.get(name, InputFault(0))
        if suspects := kinds & InputFault(int(self._estimator["checks"]["suspects"][0])):
            yield from suspect_texts(suspects, suspicions(self._estimator[0], pack_type.estimator.settings_record[0]))

    def _input_faults(self) -> Iterator[str]:
        """Yield the faults of the last samples, one sentence each."""
        for bit, text in ((SampleStatus.WRONG_CLOCK, WRONG_CLOCK_TEXT), (SampleStatus.PROBE_FAULT, PROBE_TEXT)):
            if (self._samples["status"] & bit).any():
                yield text
        yield from self._impossible


def _message(alarm: Alarm) -> AlarmMessage:
    return AlarmMessage(f"alarm.{alarm.name}", alarm.model_dump_json().encode())


def _event(text: EventText, now_s: float) -> AlarmMessage:
    return AlarmMessage("event", Event(time=iso_utc(now_s), **text._asdict()).model_dump_json().encode())
