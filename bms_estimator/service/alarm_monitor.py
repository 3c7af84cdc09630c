"""Monitor that evaluates the alarms of a pack with and without samples, and reports their changes."""

import asyncio
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import structlog

from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.health import HookHealth
from bms_estimator.pack.pack import Pack, Step
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarm_limits import min_charge_current_a, monitored_alarms, silent_limit_s
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.source import ReceivedSamples, Source
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.alarms.inputs import Inputs
from bms_estimator.telemetry.alarms.message import Change
from bms_estimator.telemetry.alarms.sample_intervals import UNUSABLE_KINDS, SampleCounts
from bms_estimator.telemetry.alarms.sensor_faults import BoardResets
from bms_estimator.telemetry.cells import cell_faults
from bms_estimator.telemetry.health import sample_counters, suspicions
from bms_estimator.telemetry.impossible import PackBounds

if TYPE_CHECKING:
    from bms_estimator.estimator.cell_estimator import CellDeviations

EVALUATION_S = 0.1
"""Interval between two evaluations [s]. An evaluation of each block would take as long as the estimate."""
EVALUATION_ROWS = 1024
"""Number of samples after which the alarms are evaluated before ``EVALUATION_S`` has elapsed."""

log = structlog.get_logger(__name__)


class AlarmMonitor:
    """Monitor of the alarms of one pack. Changes are logged, and passed to a callback.

    Args:
        settings: The pack's settings.
        pack: The pack; read only.
        source: Supplies counters, and the reason why no samples arrive.
        clock: The clocks.
        on_alarm: Called with each change of an alarm, as soon as it occurs.
        hooks: Successes and failures of alarm hooks; None without hooks.

    Attributes:
        alarms: The monitored alarms and their states.
        report: All alarms as of the last evaluation. An alarm that was raised and has ended since the previous one is
            reported as raised.
        changed: Event that is set with each change of an alarm.

    Raises:
        UserError: A setting of the alarms is not valid for the pack (``watched``).
    """

    def __init__(
        self,
        settings: Settings,
        pack: Pack,
        source: Source,
        clock: Clock,
        on_alarm: Callable[[Change], object],
        hooks: Callable[[], HookHealth | None] = lambda: None,
    ) -> None:
        self._pack, self._hooks, cell = pack, hooks, pack.model
        self._cells_seen: CellDeviations | None = None  # evaluated last
        self._board_resets = BoardResets()
        self._relay_resets = 0  # number of resets that undid a relay level, at the last evaluation
        self._estimator, self._source, self._clock, self._on_alarm = pack.estimator, source, clock, on_alarm
        gap_s = float(pack.estimator.settings["gap_s"][0])
        inputs = Inputs(settings.alarms.lost_s, cell.cell.series_count)
        self.alarms = AlarmEvaluator(
            monitored_alarms(settings, cell),
            min_charge_current_a(cell),
            gap_s,
            inputs,
            silent_limit_s(settings),
            PackBounds.of(cell),
        )
        self.report = self.alarms.report()
        self.changed = asyncio.Event()
        # arrival of the last sample, accepted or not, on the monotonic clock and on the wall clock [s]
        self._last_sample_s, self._arrival_s = clock.monotonic(), clock.wall()
        self._evaluated_s = -math.inf
        self._is_stopped = False

    def add(self, received: ReceivedSamples, step: Step, now_s: float, cells_fault: str = "") -> bool:
        """Add received samples and their estimates; evaluate the alarms if this is due.

        Args:
            received: Samples and cell voltages.
            step: Result of the samples.
            now_s: Monotonic clock [s].
            cells_fault: Reason why the cell voltages cannot be used; empty if they can.

        Returns:
            True if an alarm has changed.
        """
        self.alarms.add(received.samples, step.trace, received.cells_v, step.forecasts, cells_fault, received.probes)
        self._last_sample_s, self._arrival_s = now_s, self._clock.wall()
        is_due = now_s - self._evaluated_s >= EVALUATION_S or self.alarms.rows >= EVALUATION_ROWS
        return is_due and self.evaluate(now_s)

    def evaluate(self, now_s: float) -> bool:
        """Evaluate the alarms from the samples since the last call, or from their absence; no effect after ``stop``.

        Args:
            now_s: Monotonic clock [s].

        Returns:
            True if an alarm has changed.
        """
        if self._is_stopped:
            return False
        elapsed_s, self._evaluated_s = now_s - self._evaluated_s, now_s
        record = self._estimator.record[0]
        suspects = InputFault(int(record["checks"]["suspects"]))
        texts = suspicions(record, self._estimator.settings_record[0]) if suspects else ()
        self.alarms.evaluate(self._arrival_s, self._counts(), suspects, texts, self._source.clock_fault)
        self.alarms.evaluate_weak_cell(
            self._pack.slow_fit.weak_cell_std if self._pack.slow_fit else math.nan, self._arrival_s
        )
        cells = self._pack.cells.deviations if self._pack.cells else None
        if cells is not None and cells is not self._cells_seen:
            self._cells_seen = cells
            self.alarms.evaluate_cells(cell_faults(cells), self._arrival_s)
        self._evaluate_silence(now_s)
        resets = self._source.counters.get("resets", 0)
        self.alarms.evaluate_resets(self._board_resets.update(resets, now_s), self._clock.wall())
        if (hooks := self._hooks()) is not None:
            is_undone = hooks.relay_resets > self._relay_resets
            self._relay_resets = hooks.relay_resets
            self.alarms.evaluate_hooks(hooks.failing, elapsed_s, self._clock.wall(), is_undone=is_undone)
        return self._report_changes()

    def check_silence(self) -> bool:
        """Evaluate the time since the last sample, before a sample or a relay command that follows a suspend hides it.

        Returns:
            True once due alarms would be raised (``AlarmEvaluator.is_watching``).
        """
        now_s = self._clock.monotonic()
        if now_s - self._evaluated_s >= EVALUATION_S:
            self._evaluate_silence(now_s)
            self._report_changes()
        return self.alarms.is_watching

    def stop(self) -> None:
        """Change no alarm from now on. The final save would lack the change, although hooks have reported it."""
        self._is_stopped = True

    def acknowledge(self, name: AlarmName | None) -> list[AlarmName]:
        """Acknowledge an alarm; None: all alarms. Return the acknowledged alarms.

        Raises:
            UserError: The service is stopping.
        """
        if self._is_stopped:
            raise UserError("the service is stopping")
        acknowledged = self.alarms.acknowledge(name)
        self._report_changes()
        return acknowledged

    def acknowledge_on_signal(self) -> None:
        """Acknowledge all alarms, because a person on this machine requested it with a signal."""
        try:
            log.info("alarms acknowledged by SIGUSR1", alarms=self.acknowledge(None))
        except UserError as error:
            log.warning("alarms not acknowledged by SIGUSR1", reason=str(error))

    def restore(self, saved_state: str, *, crashed: bool = False) -> str:
        """Restore the ``alarms.saved_state`` of an earlier run, which may have ``crashed``.

        Returns:
            Reason for which raised alarms may be missing; empty if the alarms are complete.
        """
        try:
            lost_reason = self.alarms.restore(saved_state, self._clock.wall() if crashed else None)
        except Exception as error:  # noqa: BLE001 - a damaged state may raise anything, and is reported
            lost_reason = f"the saved state of the alarms is damaged ({error!r})"
        self.report = self.alarms.report()
        return lost_reason

    def raise_state_lost(self, reason: str) -> None:
        """Raise ``alarm_state_lost``, and pass it to the callback."""
        self.alarms.raise_state_lost(reason, self._clock.wall(), self._measured)
        self._report_changes()

    def _evaluate_silence(self, now_s: float) -> None:
        reason = self._source.silence_reason or ""
        self.alarms.on_silence(now_s - self._last_sample_s, self._clock.wall(), reason, now_s)

    @property
    def _measured(self) -> dict[Quantity, int]:
        """Number of values in a sample by quantity, as far as the state of the estimators shows that they were measured."""
        if not self._estimator.state["started"][0]:
            return {}
        measured: dict[Quantity, int] = {"voltage": 1, "current": 1}
        if self._estimator.record["filter"]["sensed"][0]:
            measured["temperature"] = 1
        if self._pack.cells and self._pack.cells.cells.size:
            measured["cells"] = self._pack.cells.cells.size - 1  # one may never have been measured
        return measured

    def _counts(self) -> SampleCounts:
        """Return the sample counters.

        The larger one of lost frames and errors counts, because a damaged frame is also missing in the sequence of frames.
        """
        line, samples = self._source.counters, sample_counters(self._estimator.state[0])
        lost = max(line.get("frames_lost", 0), sum(n for name, n in line.items() if name.endswith("_errors")))
        return SampleCounts(samples["samples"], lost + sum(samples[f"dropped_{kind}"] for kind in UNUSABLE_KINDS))

    def _report_changes(self) -> bool:
        """Update the report, log all new changes and pass them to the callback. Return True if there are any."""
        self.report = self.alarms.report()
        changes = self.alarms.changes()
        for change in changes:
            alarm = change.alarm
            if change.field == "watched":
                write_log = log.info if alarm.watched else log.warning
                write_log("alarm watched", alarm=alarm.name, watched=alarm.watched, reason=alarm.unwatched_reason)
            elif alarm.active:
                log.warning("alarm raised", alarm=alarm.name, severity=alarm.severity, reason=alarm.text)
            else:
                log.info("alarm cleared", alarm=alarm.name)
            self._on_alarm(change)
            self.changed.set()
        return bool(changes)
