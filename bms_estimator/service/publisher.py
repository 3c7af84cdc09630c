"""Publisher of snapshots of window, estimator and source to all sinks, at the publish rate."""

import math
from collections.abc import Callable, Mapping, Sequence

import structlog

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import FRESH_PERIODS, Health, LoopHealth
from bms_estimator.model.payloads.snapshot import ForecastReport, Info, Snapshot
from bms_estimator.pack.pack import Pack, RunResult
from bms_estimator.service.alarm_monitor import AlarmMonitor
from bms_estimator.service.service_status import LatencyHistogram, ServiceStatus
from bms_estimator.settings.alarm_limits import short_limit_a
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources.source import ReceivedSamples, Source
from bms_estimator.telemetry.alarms.definitions import Change
from bms_estimator.telemetry.cells import make_cells_payload, single_cell_fields
from bms_estimator.telemetry.health import (
    DEVICE_SOC_SUSPICION,
    contradicts_device,
    dropped_text,
    make_health_payload,
    out_of_range_reason,
    pack_model_health,
    sample_counters,
)
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import (
    ChargeEnergy,
    LifetimeTotals,
    RestDetector,
    Window,
    WindowSummary,
    new_totals,
)
from bms_estimator.telemetry.state import (
    finite,
    make_forecast_payload,
    make_info_payload,
    make_state_payload,
    no_forecast,
    remaining_capacity_ah,
)

log = structlog.get_logger(__name__)

SLOW_INTERVAL_S = 1.0
"""Minimum interval between two payloads of parameters, health or info, at any publish rate [s]."""
FORECAST_INTERVAL_S = 60.0
"""Minimum interval between two payloads of the forecast's curves [s]."""
CELLS_INTERVAL_S = 60.0
"""Minimum interval between two comparisons of the cells [s]."""
DROP_LOG_INTERVAL_S = 300.0
"""Minimum interval between two log lines on samples out of range [s]. The first one is logged at once."""
MAX_HOLD_S = 10.0
"""Maximum time from the first sample for which the first estimate waits for the SOC of the device [s]. Most devices report
all values within it, even one by one."""
SOURCE_HUNG_S = 20.0
"""Time after which a source whose task has not run counts as hung [s]. A missing port is retried at least every 10 s."""


class Publisher:
    """Publisher that makes snapshots at intervals, and passes them to the sinks.

    Args:
        settings: The pack's settings.
        pack: The pack; read only.
        source: Supplies counters, the reason of a silence, and properties of the device.
        sinks: Destinations of the snapshots.
        clock: The clocks.
        status: State of the service around the pack.
        totals: Lifetime totals; default: new totals.
        on_alarm: Called with each change of an alarm.

    Attributes:
        alarm_monitor: Alarm monitor.
        latest: The last estimate.
        snapshot: The last snapshot.
    """

    def __init__(
        self,
        settings: Settings,
        pack: Pack,
        *,
        source: Source,
        sinks: Sequence[Sink],
        clock: Clock,
        status: ServiceStatus | None = None,
        totals: LifetimeTotals | None = None,
        on_alarm: Callable[[Change], object] = lambda _: None,
    ) -> None:
        cell, estimator = pack.model, pack.estimator
        self._settings, self._pack, self._cell, self._estimator = settings, pack, cell, estimator
        self._status = status or ServiceStatus()
        self._source, self._sinks, self._clock = source, sinks, clock
        self._totals = totals or LifetimeTotals(estimator, new_totals(clock.wall()))
        self._rest = RestDetector(cell.cell.current_max_a, settings.sensor.voltage_resolution_v)
        self._board: Mapping[str, str] = {}
        self._latency = LatencyHistogram()
        self._forecast_sent_s = -math.inf  # time of the last payload of the curves
        self._no_forecast = no_forecast(cell.no_forecast_reason)
        self._device_soc: float | None = None  # SOC that the device reported last
        self._charge_energy = ChargeEnergy()  # charge and energy as last published
        self.set_rate(settings.publish.rate_hz)
        self._window = Window()
        self._cells_sent_s = -math.inf  # time of the last comparison of the cells, monotonic clock
        self.alarm_monitor = AlarmMonitor(settings, pack, source, clock, on_alarm, self._status.hooks)
        self._short_limit_a = short_limit_a(settings, cell)
        self._contradiction = False  # True: the SOC contradicts the one that the device reports
        self._logged_faults = 0, False  # bits of ``InputFault``, and ``_contradiction``, as last logged
        self._lag_s = 0.0
        self._started_s, self._started_wall_s = clock.monotonic(), clock.wall()
        self._due_s = self._started_s
        self._last_sample_s = -math.inf  # arrival of the last accepted sample, monotonic clock
        self._drop_logged_s = -math.inf
        self._drop_reason: str | None = None  # reason why the last sample was dropped; None: it was accepted
        self._dropped_before = self._dropped_counts()  # by kind, when the last sample was accepted
        self._hold_end_s = math.inf  # time until which the first estimate may be held back, monotonic clock
        self.latest: Estimate | None = None
        self.snapshot = self._first_snapshot()

    def set_rate(self, rate_hz: float) -> None:
        """Set the publish rate from the next publication on [1/s]."""
        publish = self._settings.publish.model_copy(update={"rate_hz": rate_hz})
        self._settings = self._settings.model_copy(update={"publish": publish})
        self.period_s = 1.0 / rate_hz
        self._fresh_s = FRESH_PERIODS * max(self.period_s, self._settings.sensor.sample_period_s)

    @property
    def wait_s(self) -> float:
        """Time until a snapshot is overdue [s]. A snapshot is overdue only if no samples arrive."""
        return max(self._due_s + 0.5 * self.period_s - self._clock.monotonic(), 0.0)

    def add(self, received: ReceivedSamples, result: RunResult, cells_fault: str = "") -> None:
        """Add received samples and their estimates; publish if a snapshot is due or an alarm has changed.

        Args:
            received: Samples and cell voltages.
            result: Result of the samples.
            cells_fault: Reason why the cell voltages cannot be used (``CellSlots.fault``); empty if they can.
        """
        self.add_estimates(received, result)
        self.add_to_alarms(received, result, cells_fault)

    def add_estimates(self, received: ReceivedSamples, result: RunResult) -> bool:
        """Add the estimates without evaluating the alarms. Return True if a snapshot was published.

        ``add_to_alarms`` evaluates the alarms later, so that they do not delay the estimate. It also publishes the first snapshot,
        because this snapshot lists the alarms that the first samples raise.
        """
        if self._status.source_health:
            self._latency.add(self._status.source_health().block_age_s)
        now_s, trace = self._clock.monotonic(), result.trace
        if trace.size:
            self._window.add(trace, self._clock.wall(), received.cells_v, received.probes)
            self._last_sample_s = now_s
            self._hold_end_s = min(self._hold_end_s, now_s + MAX_HOLD_S)
        self._device_soc = finite(received.device_soc[-1]) if received.device_soc.size else None
        if trace.size < received.samples.size:
            self._drop_reason = out_of_range_reason(received.samples, self._estimator.settings[0]) or ""
            if self._drop_reason and now_s - self._drop_logged_s >= DROP_LOG_INTERVAL_S:
                self._drop_logged_s = now_s
                log.warning("samples are dropped", reason=self._drop_reason)
        elif self._drop_reason is not None:
            self._drop_reason, self._dropped_before = None, self._dropped_counts()
        if now_s < self._due_s or not self.latest:
            return False
        self._publish_snapshot(now_s)
        return True

    def add_to_alarms(self, received: ReceivedSamples, result: RunResult, cells_fault: str = "") -> None:
        """Evaluate the alarms of the samples that were passed to ``add_estimates``."""
        now_s = self._clock.monotonic()
        alarm_changed = self.alarm_monitor.add(received, result, now_s, cells_fault)
        if not self.latest and now_s >= self._due_s and not self._is_held(now_s):
            self.publish()
        elif alarm_changed:
            self._pass_to_sinks(self.snapshot._replace(estimate=None, alarms=self.alarm_monitor.report))

    def add_lag(self, lag_s: float) -> None:
        """Add a measured delay of the event loop [s]."""
        self._lag_s = max(self._lag_s, lag_s)

    def publish(self) -> None:
        """Evaluate the alarms, make a snapshot, and pass it to all sinks."""
        now_s = self._clock.monotonic()
        self.alarm_monitor.evaluate(now_s)
        self._publish_snapshot(now_s)

    def _publish_snapshot(self, now_s: float) -> None:
        """Make a snapshot with the alarms of their last evaluation, and pass it to all sinks."""
        self._due_s += self.period_s
        if self._due_s <= now_s:  # a publisher that is late skips the missed publications
            self._due_s = now_s + self.period_s
        snapshot = self._next_snapshot(now_s)
        if snapshot.estimate is not None:
            self.latest = snapshot.estimate
            self._rest.add(self.latest, now_s)
        elif not snapshot.health.sensor_online:
            self._rest.reset()
        self._pass_to_sinks(snapshot)

    def _pass_to_sinks(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        for sink in self._sinks:
            sink.publish(snapshot)

    def publish_last(self) -> None:
        """Publish a last snapshot with all payloads recomputed, also with an estimate that was held back."""
        self._hold_end_s = self._slow_sent_s = self._forecast_sent_s = self._cells_sent_s = -math.inf
        self.publish()

    @property
    def alive(self) -> bool:
        """True while samples arrive or the task of the source runs."""
        fresh = self._clock.monotonic() - self._last_sample_s <= self._fresh_s
        health = self._status.source_health
        return fresh or health is None or health().task_idle_s <= SOURCE_HUNG_S

    @property
    def status(self) -> str:
        """Short text about the pack for systemd."""
        if self.snapshot.health.sensor_message:
            return f"no samples: {self.snapshot.health.sensor_message}"
        soc = self.latest.soc if self.latest else None
        return "" if soc is None else f"SOC {soc:.2f}"

    @property
    def not_at_rest_reason(self) -> str | None:
        """Reason why the pack may not be at rest; None when it is at rest."""
        return self.snapshot.health.sensor_message or self._rest.not_at_rest_reason(self._clock.monotonic())

    def _first_snapshot(self) -> Snapshot:
        now_s = self._slow_sent_s = self._started_s
        return Snapshot(
            None,
            make_parameters_payload(self._estimator, self._started_wall_s),
            self._make_health(now_s, self._sensor_message(now_s)),
            self._make_info(),
            self.alarm_monitor.report,
        )

    def _next_snapshot(self, now_s: float) -> Snapshot:
        """Return a snapshot with the estimate of this window. Other payloads are recomputed only when they are due."""
        _, parameters, health, info, _, forecast, cells = self.snapshot
        summary, wall_s = None if self._is_held(now_s) else self._window.take(), self._clock.wall()
        estimate = self._make_estimate(summary, wall_s) if summary else None
        if summary and now_s - self._forecast_sent_s >= FORECAST_INTERVAL_S:
            self._forecast_sent_s, forecast = now_s, self._make_forecast(summary, wall_s)
        message = self._sensor_message(now_s)
        slow_due = now_s - self._slow_sent_s >= SLOW_INTERVAL_S
        if slow_due:
            self._slow_sent_s = now_s
            parameters, info = make_parameters_payload(self._estimator, wall_s), self._make_info()
        if slow_due or health.sensor_online != (message is None):
            health = self._make_health(now_s, message)
            self._log_input_faults(health)
        if now_s - self._cells_sent_s >= CELLS_INTERVAL_S and self._deviations is not None:
            self._cells_sent_s, cells = now_s, make_cells_payload(self._deviations, self._short_limit_a, wall_s)
        return Snapshot(estimate, parameters, health, info, self.alarm_monitor.report, forecast, cells)

    def _is_held(self, now_s: float) -> bool:
        """Return True if the first estimate still waits for the SOC of the device."""
        return self._pack.awaits_prior and not self.latest and now_s < self._hold_end_s

    @property
    def _deviations(self) -> CellDeviations | None:
        return self._pack.cells.deviations if self._pack.cells else None

    def _make_estimate(self, window: WindowSummary, wall_s: float) -> Estimate:
        # only saved values are published, so that the next run continues from the published ones
        self._charge_energy = self._charge_energy.at_least(
            self._status.saved_charge_energy or self._totals.charge_energy
        )
        forecast, forecaster = self._no_forecast, self._pack.forecaster
        if forecaster:
            forecast = forecaster.latest_at(window.voltage_v, window.current_a, window.power_w)
        return make_state_payload(
            window,
            remaining_capacity_ah(self._estimator),
            forecast,
            self._source.counters,
            wall_s,
            self._charge_energy,
            self._cell.capacity_ah,
            single_cell_fields(self._pack),
            self._device_soc,
        )

    def _make_forecast(self, window: WindowSummary, wall_s: float) -> ForecastReport | None:
        forecaster = self._pack.forecaster
        return make_forecast_payload(forecaster.latest, forecaster.cutoff_v, window, wall_s) if forecaster else None

    def _make_health(self, now_s: float, message: str | None) -> Health:
        lag_s, self._lag_s, status, slow_fit = self._lag_s, 0.0, self._status, self._pack.slow_fit
        record, device_std = self._estimator.record[0], self._settings.pack.device_soc_std
        self._contradiction = contradicts_device(record, self._device_soc, device_std, before=self._contradiction)
        return make_health_payload(
            record,
            self._estimator.settings_record[0],
            self._source.counters,
            now_s=self._clock.wall(),
            uptime_s=now_s - self._started_s,
            loop_lag_s=lag_s,
            restarts=status.restarts,
            checkpoint=status.checkpoint,
            sensor_message=message,
            delivery=status.delivery,
            clock_ppm=self._source.clock_ppm,
            total=self._totals.total,
            unseen_s=self._totals.unseen_s,
            loop=self._loop_health(),
            recording=status.recording(),
            edge=status.edge(),
            hooks=status.hooks(),
            pack_model=pack_model_health(slow_fit, status.fit_times()) if slow_fit else None,
            contradictions=[*status.contradictions, *[DEVICE_SOC_SUSPICION] * self._contradiction],
        )

    def _log_input_faults(self, health: Health) -> None:
        """Log the suspected input faults when their set changes; the numbers in their texts change more often."""
        suspects = int(self._estimator.record["checks"]["suspects"][0]), self._contradiction
        if suspects != self._logged_faults:
            self._logged_faults = suspects
            log.warning("suspected input faults", suspects=health.suspects or "none")

    def _loop_health(self) -> LoopHealth:
        p50_s, p99_s, max_s = self._latency.pop_summary() or (None, None, None)
        status = self._status
        return LoopHealth(
            latency_p50_s=p50_s,
            latency_p99_s=p99_s,
            latency_max_s=max_s,
            reads_waiting=status.source_health().queued_reads if status.source_health else 0,
            messages_waiting=status.delivery.waiting,
            log_lines_lost=status.log_lines_lost,
            disk_free_mib=status.disk_free_mib,
        )

    def _make_info(self) -> Info:
        self._board = self._source.board or self._board  # properties of an unplugged board remain
        sensed = bool(self._estimator.record["filter"]["sensed"][0])
        return make_info_payload(
            self._settings, self._cell, self._board, self._started_wall_s, temperature_sensor=sensed
        )

    def _sensor_message(self, now_s: float) -> str | None:
        """Return the reason why no fresh values arrive; None when they do."""
        silent_s = now_s - self._last_sample_s
        if silent_s <= self._fresh_s:
            return None
        if self._source.silence_reason:
            return self._source.silence_reason
        if math.isinf(silent_s):
            silent_s = now_s - self._started_s
        dropped = {kind: n - self._dropped_before[kind] for kind, n in self._dropped_counts().items()}
        text = f"no usable sample for {silent_s:.1f} s"
        text += f"; dropped since: {dropped_text(dropped)}" if any(dropped.values()) else ""
        return f"{text}; {self._drop_reason}" if self._drop_reason else text

    def _dropped_counts(self) -> dict[str, int]:
        """Return the dropped samples by kind."""
        counted = sample_counters(self._estimator.state[0]).items()
        return {name.removeprefix("dropped_"): n for name, n in counted if name.startswith("dropped_")}
