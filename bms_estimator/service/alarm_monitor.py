"""Monitor that evaluates the alarms of a pack with and without samples, and reports their changes."""

import asyncio
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import structlog

from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.events import watch_events
from bms_estimator.model.payloads.health import HookHealth
from bms_estimator.pack.pack import Pack, RunResult
from bms_estimator.settings.alarm_kinds import Quantity
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.source import ReceivedSamples, Source
from bms_estimator.telemetry.alarms.causes import BoardResets
from bms_estimator.telemetry.alarms.definitions import Change
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.cells import cell_alarm_inputs

if TYPE_CHECKING:
    from bms_estimator.estimator.cell_estimator import CellDeviations

EVALUATION_INTERVAL_S = 0.1
"""Minimum interval between two reports of changes, and between two evaluations of silence, resets and hooks [s]."""

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
        UserError: A setting of the alarms is not valid for the pack (``monitored_alarms``).
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
        self._pack, self._hooks = pack, hooks
        self._cells_seen: CellDeviations | None = None  # the deviations that were evaluated last
        self._board_resets = BoardResets()
        self._relay_resets = 0  # number of resets that undid a relay level, at the last evaluation
        self._estimator, self._source, self._clock, self._on_alarm = pack.estimator, source, clock, on_alarm
        self.alarms = AlarmEvaluator(settings, pack.estimator)
        self.report = self.alarms.report()
        self.changed = asyncio.Event()
        self._last_sample_s = clock.monotonic()  # arrival of the last sample, accepted or not
        self._evaluated_s = -math.inf
        self._is_stopped = False

    def add(self, received: ReceivedSamples, result: RunResult, now_s: float, cells_fault: str = "") -> bool:
        """Evaluate the alarms on received samples and their estimates; report changes if this is due.

        Args:
            received: Samples and cell voltages.
            result: Result of the samples.
            now_s: Monotonic clock [s].
            cells_fault: Reason why the cell voltages cannot be used; empty if they can.

        Returns:
            True if a change was reported.
        """
        if not self._is_stopped:
            cells, slow_fit = self._pack.cells.deviations if self._pack.cells else None, self._pack.slow_fit
            is_new, self._cells_seen = cells is not self._cells_seen, cells
            self.alarms.evaluate(
                received.samples,
                result.trace,
                received.cells_v,
                self._clock.wall(),
                forecasts=result.forecasts,
                probes=received.probes,
                cells_fault=cells_fault,
                clock_fault=self._source.clock_fault,
                conflict=self._source.conflict,
                lost=self._lost_samples,
                cell_alarm_inputs=cell_alarm_inputs(cells) if cells is not None and is_new else None,
                weak_cell_std=slow_fit.weak_cell_std if slow_fit else math.nan,
            )
        self._last_sample_s = now_s
        return now_s - self._evaluated_s >= EVALUATION_INTERVAL_S and self.evaluate(now_s)

    def evaluate(self, now_s: float) -> bool:
        """Evaluate silence, resets of the board and hooks, and report all changes; no effect after ``stop``.

        Args:
            now_s: Monotonic clock [s].

        Returns:
            True if a change was reported.
        """
        if self._is_stopped:
            return False
        elapsed_s, self._evaluated_s = now_s - self._evaluated_s, now_s
        self._evaluate_silence(now_s)
        resets = self._source.counters.get("resets", 0)
        self.alarms.evaluate_resets(self._board_resets.update(resets, now_s), self._clock.wall())
        if (hooks := self._hooks()) is not None:
            is_undone = hooks.relay_resets > self._relay_resets
            self._relay_resets = hooks.relay_resets
            self.alarms.evaluate_hooks(hooks.failing, elapsed_s, self._clock.wall(), is_undone=is_undone)
        return self._report_changes()

    def check_silence(self) -> bool:
        """Evaluate the time since the last sample. Call this before samples or a relay command, so that no suspend is missed.

        Returns:
            True once enough samples have arrived to raise all due alarms (``AlarmEvaluator.is_watching``).
        """
        now_s = self._clock.monotonic()
        if now_s - self._evaluated_s >= EVALUATION_INTERVAL_S:
            self._evaluate_silence(now_s)
            self._report_changes()
        return self.alarms.is_watching

    def stop(self) -> None:
        """Ignore further changes of the alarms: hooks would act on a change that the final save lacks."""
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
        self.alarms.raise_state_lost(reason, self._clock.wall(), self._measured_counts)
        self._report_changes()

    def _evaluate_silence(self, now_s: float) -> None:
        reason = self._source.silence_reason or ""
        self.alarms.on_silence(now_s - self._last_sample_s, self._clock.wall(), reason, now_s)

    @property
    def _measured_counts(self) -> dict[Quantity, int]:
        """Number of values in a sample by quantity, for the quantities that the estimators have received."""
        if not self._estimator.state["started"][0]:
            return {}
        measured: dict[Quantity, int] = {"voltage": 1, "current": 1}
        if self._estimator.record["filter"]["sensed"][0]:
            measured["temperature"] = 1
        if self._pack.cells and self._pack.cells.cells.size:
            measured["cells"] = self._pack.cells.cells.size - 1  # one may never have been measured
        return measured

    @property
    def _lost_samples(self) -> int:
        """Number of samples that were lost on the line.

        The larger of lost frames and errors counts, because a damaged frame is also missing in the sequence of frames.
        """
        counters = self._source.counters
        return max(counters.get("frames_lost", 0), sum(n for name, n in counters.items() if name.endswith("_errors")))

    def _report_changes(self) -> bool:
        """Update the report, log all new changes and pass them to the callback. Return True if there are any."""
        self.report = self.alarms.report()
        changes = self.alarms.changes()
        for change in changes:
            alarm = change.alarm
            if change.field == "active" and alarm.active:
                log.warning("alarm raised", alarm=alarm.name, severity=alarm.severity, reason=alarm.text)
            elif change.field == "active":
                log.info("alarm cleared", alarm=alarm.name)
            self._on_alarm(change)
            self.changed.set()
        for event in watch_events(change.alarm for change in changes if change.field == "watched"):
            write_log = log.info if event.name == "alarm_watched" else log.warning
            write_log(event.name.replace("_", " "), alarms=event.text)
        return bool(changes)
