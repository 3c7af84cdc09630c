"""Live loop that passes samples from the source to the estimator, and estimates to the sinks.

A thread fits the pack's model, so that a fit delays neither samples nor messages.
"""

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

import structlog

from bms_estimator.checkpoint.run_file import RunCounters, SavedRun
from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.edge.block_sender import BlockSender
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_plausibility import Contradictions
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.clock import Clock, since_boot
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.process.runtime import acknowledge_on_signal, until_first_ends
from bms_estimator.process.stderr_writer import DaemonThreadExecutor, stderr
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.checkpoint_writer import CheckpointWriter
from bms_estimator.service.publisher import Publisher
from bms_estimator.service.request_handlers import RequestHandlers
from bms_estimator.service.service_status import ServiceStatus
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources.serial.board_check import BoardCheck
from bms_estimator.sources.source import Source
from bms_estimator.telemetry.health import FitTimes
from bms_estimator.telemetry.publish_window import LifetimeTotals, new_totals

LOG_INTERVAL_S = 3600.0
"""Minimum interval between two log lines for each kind of exception [s]; all failures are counted."""


class FitThread:
    """Runs the fits of one pack one after the other, and logs their failures.

    Args:
        clock: The clocks.
        executor: Runs the fits; default: a daemon thread, so that the service can exit during a fit.

    Attributes:
        times: End and duration of the last fit, failed or not.
    """

    def __init__(self, clock: Clock, executor: Executor | None = None) -> None:
        self._clock, self._executor = clock, executor or DaemonThreadExecutor("fit")
        self._logged_s: dict[str, float] = {}
        self.times = FitTimes(None, None)

    def submit(self, call: Callable[[], PackFit]) -> "Future[PackFit]":
        """Queue a fit, and return its future."""
        return self._executor.submit(self._measure, call)

    def log_failure(self, error: BaseException) -> None:
        """Log the exception of a fit, once in ``LOG_INTERVAL_S`` for each kind."""
        kind, now_s = type(error).__name__, self._clock.monotonic()
        if now_s - self._logged_s.get(kind, -math.inf) >= LOG_INTERVAL_S:
            self._logged_s[kind] = now_s
            log.warning("the fit of the pack's model failed; the previous fit stays", kind=kind, exc_info=error)

    def _measure(self, call: Callable[[], PackFit]) -> PackFit:
        started_s = self._clock.monotonic()
        try:
            return call()
        finally:
            self.times = FitTimes(self._clock.wall(), self._clock.monotonic() - started_s)


LAG_INTERVAL_S = 0.1
"""Interval at which the loop's lag is measured [s]. Any longer blocking of the loop is noticed."""
SEND_ITERATIONS = 2
"""Iterations of the event loop that send a published estimate: one takes it from the outbox, one writes it."""
STATUS_INTERVAL_S = 60.0
"""Interval between two SOC texts for systemd [s]. It is reported at once when samples begin or cease to arrive."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class ServiceParts:
    """Optional parts of a service around its live loop."""

    status: ServiceStatus = field(default_factory=ServiceStatus)
    """State of the service around the pack. The loop adds the state of its own parts."""
    requests: RequestDispatcher | None = None
    """Dispatcher at which the loop registers its handlers."""
    store_current_zero: Callable[[], Awaitable[None]] | None = None
    """Makes the board store the present current as zero; None: the source has no such command."""
    board_check: BoardCheck | None = None
    """Reports that the calibration of the board has changed; None: the source has no such check."""
    notifier: SystemdNotifier | None = None
    """Notifies systemd that the loop is ready and alive."""
    hooks: AlarmHooks | None = None
    """Alarm hooks; opened and closed by the loop."""
    edge: BlockSender | None = None
    """Sender that also receives all samples. Its owner opens and closes it."""
    fit_executor: Executor | None = None
    """Runs the fits of the pack's model; None: a separate thread."""


async def run_estimation_loop(
    settings: Settings,
    model: PackModel,
    *,
    source: Source,
    sinks: Sequence[Sink],
    stop: asyncio.Event,
    files: StateFiles | None = None,
    parts: ServiceParts | None = None,
    clock: Clock | None = None,
) -> Estimator:
    """Estimate until the source ends or ``stop`` is set.

    Args:
        settings: The pack's settings.
        model: Model of the whole pack.
        source: Supplies samples; opened and closed here.
        sinks: Destinations of the snapshots; opened and closed here.
        stop: Event that ends the loop cleanly.
        files: Files of the pack's state; None: it is not saved.
        parts: Parts of the service; default: none.
        clock: The clocks.

    Returns:
        The estimator after the last sample.
    """
    name, clock, parts = settings.pack.name, clock or Clock(), parts or ServiceParts()
    hooks = parts.hooks or AlarmHooks((), name, None, None)
    notifier = parts.notifier or SystemdNotifier([name])
    fit_thread, status = FitThread(clock, parts.fit_executor), parts.status
    pack = new_pack(settings, model, submit=fit_thread.submit, on_failure=fit_thread.log_failure)
    saved_run = files.read_counters() if files else SavedRun(RunCounters(0, new_totals(clock.wall())))
    counters, begin_s = saved_run.counters, since_boot()
    status.hooks, status.fit_times, status.restarts = lambda: hooks.health, lambda: fit_thread.times, counters.restarts
    if files:
        status.checkpoint = files.restore(pack)
    if parts.edge:
        status.edge = parts.edge.health
    totals = LifetimeTotals(pack.estimator, counters.total)
    publisher = Publisher(
        settings,
        pack,
        source=source,
        sinks=sinks,
        clock=clock,
        status=status,
        totals=totals,
        on_alarm=hooks.on_alarm_change,
    )
    monitor = publisher.alarm_monitor
    restore_error = monitor.restore(counters.alarms, crashed=saved_run.crashed)
    hooks.check_watching = monitor.check_silence
    hooks.restore_active(monitor.report, counters.hooks, crashed=saved_run.crashed)
    if lost_reason := saved_run.lost_reason or restore_error:
        # after restore_active, so that the hooks announce this alarm
        monitor.raise_state_lost(lost_reason)
    if parts.board_check:
        # the values on which the alarms depend may be wrong with another calibration
        parts.board_check.on_recalibrated = monitor.raise_state_lost
    # while an alarm is raised or a cell is missing, the cells keep their slots of the earlier run, because a floating input
    # could be taken for the missing cell
    keeps_slots = monitor.alarms.active or monitor.alarms.unwatched_critical
    slots = CellSlots(
        model.cell.series_count, slots=counters.cell_slots if keeps_slots else (), earlier=counters.cell_slots
    )
    if parts.requests is not None:
        RequestHandlers(pack, publisher, parts.store_current_zero).register(parts.requests)
    writer = (
        CheckpointWriter(
            pack,
            files,
            alarms=monitor,
            totals=totals,
            hooks=hooks,
            slots=slots,
            status=status,
            interval_s=settings.state.checkpoint_s,
        )
        if files
        else None
    )
    async with contextlib.AsyncExitStack() as stack:
        for sink in sinks:
            await stack.enter_async_context(sink)
        await stack.enter_async_context(source)
        await stack.enter_async_context(hooks)
        stack.enter_context(acknowledge_on_signal(monitor.acknowledge_on_signal))
        notifier.ready(name)
        tasks = [
            _estimate(source, pack, slots, totals, publisher, parts.edge, begin_s, status),
            _keep_alive(publisher, status, notifier, name, clock),
            _measure_lag(publisher),
        ]
        if writer:
            tasks.append(writer.run())
        clean = False
        try:
            await until_first_ends(*tasks, stop.wait())
            monitor.evaluate(clock.monotonic())  # samples since the last evaluation, for the final save
            clean = True
        finally:  # also after an exception
            notifier.stopping(name)
            hooks.stop_watching()
            monitor.stop()
            if writer:
                # before the sinks close, because closing may take seconds, and the service may be killed meanwhile
                await writer.save_final(clean=clean)
        publisher.publish_last()
    return pack.estimator


async def _estimate(
    source: Source,
    pack: Pack,
    slots: CellSlots,
    totals: LifetimeTotals,
    publisher: Publisher,
    edge: BlockSender | None,
    begin_s: float,
    status: ServiceStatus,
) -> None:
    """Pass each block of samples to the edge, the pack, the totals and the publisher.

    Args:
        source: Supplies the blocks.
        pack: The pack.
        slots: Cell slots of the source.
        totals: Lifetime totals.
        publisher: Publisher.
        edge: Sender that receives all samples; None: no sender.
        begin_s: Time since boot at which the restoration began, to which the gap of the restored state extends [s].
        status: State of the service, to which the contradictions between settings and device are written.
    """
    logged_reason, before_s, contradictions = "", begin_s, Contradictions(pack.model)
    async for each in source:
        for time_s, voltage_v, current_a in each.samples[-1:][["time_s", "voltage_v", "current_a"]].tolist():
            for text in contradictions.add(time_s, voltage_v, current_a, each.device_capacity_ah):
                log.warning("implausible setting", reason=text)
        status.contradictions = contradictions.texts
        received = each._replace(cells_v=slots.select(each.cells_v))
        if slots.reason != logged_reason:
            logged_reason = slots.reason
            if logged_reason:
                log.warning("no estimates of single cells", reason=logged_reason)
        if slots.moved_reason:
            publisher.alarm_monitor.raise_state_lost(slots.moved_reason)
        now_s = since_boot()
        pack.extend_gap(now_s - before_s)  # no effect after the first accepted sample
        before_s = now_s
        if edge:
            edge.take(received.samples, received.cells_v)
        publisher.alarm_monitor.check_silence()
        result = pack.run(received.samples, received.cells_v, received.device_soc)
        totals.add(result.trace)
        try:
            # the sinks send now, so that the alarms do not delay them and a source that always has a block does not starve them
            for _ in range(SEND_ITERATIONS if publisher.add_estimates(received, result) else 1):
                await asyncio.sleep(0)
        finally:  # the final save needs the alarms of all samples
            publisher.add_to_alarms(received, result, slots.fault)


async def _keep_alive(
    publisher: Publisher, status: ServiceStatus, notifier: SystemdNotifier, name: str, clock: Clock
) -> None:
    """Publish snapshots while samples are missing, and notify the watchdog while the publisher is alive."""
    max_wait_s = notifier.watchdog_s / 3.0 or publisher.period_s
    sent_text, sent_online, sent_s = "", False, -math.inf
    while True:
        if publisher.alive:
            notifier.alive(name)
        status.log_lines_lost = stderr.lost
        now_s, text, online = clock.monotonic(), publisher.status, publisher.snapshot.health.sensor_online
        if text != sent_text and (now_s - sent_s >= STATUS_INTERVAL_S or online != sent_online):
            notifier.status(name, text)
            sent_text, sent_online, sent_s = text, online, now_s
        await asyncio.sleep(min(max(publisher.wait_s, 0.01), max_wait_s))
        if publisher.wait_s == 0.0:
            publisher.publish()


async def _measure_lag(publisher: Publisher) -> None:
    """Measure the delay of the event loop, by which samples and requests may be late."""
    loop = asyncio.get_running_loop()
    while True:
        due_s = loop.time() + LAG_INTERVAL_S
        await asyncio.sleep(LAG_INTERVAL_S)
        publisher.add_lag(loop.time() - due_s)
