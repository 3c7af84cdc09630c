"""Live loop that passes samples from the source to the estimator, and estimates to the sinks."""

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor

import structlog

from bms_estimator.checkpoint.checkpoint_file import CheckpointFile
from bms_estimator.checkpoint.history_file import HistoryFile
from bms_estimator.checkpoint.load_file import restore_seen_load
from bms_estimator.edge.block_sender import BlockSender
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import new_estimator
from bms_estimator.forecast.forecaster import Forecaster, Runner
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.clock import Clock, since_boot
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.model.payloads.health import RecordingHealth
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.process.signals import acknowledge_on_signal
from bms_estimator.process.stderr_writer import stderr
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.process.tasks import until_first_ends
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.checkpoint_writer import CheckpointWriter, SeenLoad
from bms_estimator.service.fit_thread import FitThread, new_slow_fit
from bms_estimator.service.pack_forecaster import new_forecaster
from bms_estimator.service.publisher import Publisher
from bms_estimator.service.request_handlers import RequestHandlers
from bms_estimator.service.restored_pack import read_counters, restore_pack
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources.source import Source, SourceHealth
from bms_estimator.telemetry.lifetime_totals import LifetimeTotals
from bms_estimator.telemetry.pack_model import pack_model_health
from bms_estimator.telemetry.weakest_cell_values import weakest_cell_values

LAG_STEP_S = 0.1
"""Interval at which the loop's lag is measured [s]. Any longer blocking of the loop is noticed."""
STATUS_S = 60.0
"""Interval between two SOC texts for systemd [s]. The start and end of samples are reported at once."""

log = structlog.get_logger(__name__)


async def run_estimation_loop(
    settings: Settings,
    cell: PackModel,
    *,
    source: Source,
    sinks: Sequence[Sink],
    stop: asyncio.Event,
    checkpoint: CheckpointFile | None = None,
    requests: RequestDispatcher | None = None,
    delivery: DeliveryStats | None = None,
    current_zero: Callable[[], Awaitable[None]] | None = None,
    notifier: SystemdNotifier | None = None,
    clock: Clock | None = None,
    source_health: Callable[[], SourceHealth] | None = None,
    recording: Callable[[], RecordingHealth | None] = lambda: None,
    hooks: AlarmHooks | None = None,
    edge: BlockSender | None = None,
    history: HistoryFile | None = None,
    load_file: HistoryFile | None = None,
    fit_executor: Executor | None = None,
) -> Estimator:
    """Estimate until the source ends or ``stop`` is set.

    Args:
        settings: The pack's settings.
        cell: Model of the whole pack.
        source: Supplies samples; opened and closed here.
        sinks: Destinations of the snapshots; opened and closed here.
        stop: Event that ends the loop cleanly.
        checkpoint: File of the state; None: the state is not saved.
        requests: Dispatcher at which this loop registers its handlers.
        delivery: Counters of sent messages and received requests.
        current_zero: Makes the board store the present current as zero; None: the source has no such command.
        notifier: Is notified that the loop is ready and alive.
        clock: The clocks.
        source_health: Returns the health of the source; None: not reported.
        recording: Returns the state of a recording; None without a recording.
        hooks: Alarm hooks; opened and closed here.
        edge: Sender that also receives all samples. Its owner opens and closes it. None: no sender.
        history: File of the history and the last fit; None: they are not saved.
        load_file: File of the observed load; None: it is not saved.
        fit_executor: Runs the fits of the pack's model; None: a thread of their own.

    Returns:
        The estimator after the last sample.
    """
    name, clock = settings.pack.name, clock or Clock()
    hooks = hooks or AlarmHooks((), name, None, None)
    notifier = notifier or SystemdNotifier([name])
    estimator = new_estimator(settings, cell)
    cells = CellEstimator(estimator)
    fit_thread = FitThread(clock, fit_executor)
    pack_model = new_slow_fit(settings, estimator, submit=fit_thread.submit, on_failure=fit_thread.log_failure)
    saved_run = read_counters(checkpoint, clock)
    counters = saved_run.counters
    outcome = restore_pack(estimator, pack_model, checkpoint, history, cells)
    restored_s = since_boot()
    forecaster = new_forecaster(settings, cell, estimator, pack_model, cells)
    seen_load = SeenLoad(forecaster, load_file) if forecaster and load_file else None
    if seen_load:
        _restore_load(seen_load)
    totals = LifetimeTotals(estimator, counters.total)
    publisher = Publisher(
        settings,
        cell,
        estimator,
        source=source,
        sinks=sinks,
        clock=clock,
        restarts=counters.restarts,
        totals=totals,
        checkpoint=outcome,
        delivery=delivery,
        source_health=source_health,
        recording=recording,
        edge=edge.health if edge else lambda: None,
        hooks=lambda: hooks.health,
        pack_model=lambda: pack_model_health(pack_model, fit_thread.times) if pack_model else None,
        weakest_cell=lambda: weakest_cell_values(pack_model),
        cells=cells,
        on_alarm=hooks.on_alarm_change,
        forecaster=forecaster,
    )
    unrestored = publisher.alarm_monitor.restore(counters.alarms, crashed=saved_run.crashed)
    hooks.is_watching = lambda: publisher.alarm_monitor.alarms.is_watching
    hooks.restore_active(publisher.alarm_monitor.report, counters.hooks, crashed=saved_run.crashed)
    if lost_reason := saved_run.lost_reason or unrestored:
        # after the restored alarms, because the hooks announce this one
        publisher.alarm_monitor.raise_state_lost(lost_reason)
    # with a raised alarm the slots of the earlier run, so that a floating slot does not replace the cell that raised it
    slots = CellSlots(cell.cell.series_count, counters.cell_slots if publisher.alarm_monitor.alarms.active else ())
    if requests is not None:
        RequestHandlers(estimator, publisher, current_zero, pack_model, forecaster).register(requests)
    interval_s = settings.state.checkpoint_s
    writer = (
        CheckpointWriter(
            checkpoint,
            estimator,
            publisher,
            totals,
            restarts=counters.restarts,
            interval_s=interval_s,
            pack_model=pack_model,
            history=history,
            seen_load=seen_load,
            cells=cells,
            hooks=hooks,
            slots=slots,
        )
        if checkpoint
        else None
    )
    async with contextlib.AsyncExitStack() as stack:
        for sink in sinks:
            await stack.enter_async_context(sink)
        await stack.enter_async_context(source)
        await stack.enter_async_context(hooks)
        stack.enter_context(acknowledge_on_signal(publisher.alarm_monitor.acknowledge_on_signal))
        notifier.ready(name)
        tasks = [
            _estimate(
                source,
                estimator,
                forecaster,
                pack_model or estimator,
                totals,
                publisher,
                edge,
                restored_s,
                slots,
            ),
            _keep_alive(publisher, notifier, name, clock),
            _measure_lag(publisher),
        ]
        if writer:
            tasks.append(writer.run())
        clean = False
        try:
            await until_first_ends(*tasks, stop.wait())
            publisher.alarm_monitor.evaluate(clock.monotonic())  # samples since the last evaluation, for the final save
            clean = True
        finally:  # an exception ends the loop, too
            notifier.stopping(name)
            hooks.stop_watching()
            publisher.alarm_monitor.stop()
            if writer:
                # before the sinks close, because closing may take seconds, and the service may be killed meanwhile
                await writer.save_final(clean=clean)
        publisher.publish_last()
    return estimator


async def _estimate(
    source: Source,
    estimator: Estimator,
    forecaster: Forecaster | None,
    runner: Runner,
    totals: LifetimeTotals,
    publisher: Publisher,
    edge: BlockSender | None,
    restored_s: float,
    slots: CellSlots,
) -> None:
    """Pass each block of samples to the edge, the estimator, the totals and the publisher.

    Args:
        source: Supplies the blocks.
        estimator: Estimator.
        forecaster: Forecaster, which also runs the estimators of the single cells; None: there are no forecasts.
        runner: Runs the estimator without a forecaster.
        totals: Totals over restarts.
        publisher: Publisher.
        edge: Sender that receives all samples; None: no sender.
        restored_s: Time since boot at which the state was restored [s].
        slots: Cell slots of the source.
    """
    unseen_s, logged_reason = estimator.record["unseen_s"].copy(), ""
    async for each in source:
        received = each._replace(cells_v=slots.select(each.cells_v))
        if slots.reason != logged_reason:
            logged_reason = slots.reason
            if logged_reason:
                log.warning("no estimates of single cells", reason=logged_reason)
        if estimator.state["started"][0] and not estimator.state["samples"][0]:
            # the gap before the first sample after a restart also includes the wait for that sample
            estimator.record["unseen_s"] = unseen_s + since_boot() - restored_s
        if edge:
            edge.take(received.samples, received.cells_v)
        trace = forecaster.run(received.samples, received.cells_v) if forecaster else runner.run(received.samples)
        totals.add(trace)
        publisher.add(received, trace, slots.fault)
        await asyncio.sleep(0)  # a source that always has a block must not starve the sinks


async def _keep_alive(publisher: Publisher, notifier: SystemdNotifier, name: str, clock: Clock) -> None:
    """Publish snapshots while samples are missing, and notify the watchdog while the publisher is alive."""
    max_wait_s = notifier.watchdog_s / 3.0 or publisher.period_s
    sent_status, sent_online, sent_s = "", False, -math.inf
    while True:
        if publisher.alive:
            notifier.alive(name)
        publisher.log_lines_lost = stderr.lost
        now_s, status, online = clock.monotonic(), publisher.status, publisher.snapshot.health.sensor_online
        if status != sent_status and (now_s - sent_s >= STATUS_S or online != sent_online):
            notifier.status(name, status)
            sent_status, sent_online, sent_s = status, online, now_s
        await asyncio.sleep(min(max(publisher.wait_s, 0.01), max_wait_s))
        if publisher.wait_s == 0.0:
            publisher.publish()


async def _measure_lag(publisher: Publisher) -> None:
    """Measure the delay of the event loop, by which samples and requests may be late."""
    loop = asyncio.get_running_loop()
    while True:
        due_s = loop.time() + LAG_STEP_S
        await asyncio.sleep(LAG_STEP_S)
        publisher.add_lag(loop.time() - due_s)


def _restore_load(seen: SeenLoad) -> None:
    """Restore the load that an earlier run observed. A damaged file is logged, and the next save replaces it."""
    file, reason = str(seen.file.path), restore_seen_load(seen.file, seen.forecaster)
    if reason:
        log.warning("the observed load is damaged and was not restored", file=file, reason=reason)
    else:
        log.info("load", file=file, seconds=seen.forecaster.load.seconds)
