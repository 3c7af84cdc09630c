"""Service of one pack or several packs, for ``bms-estimator run``: source, estimator, broker, checkpoint, signals.

Several packs share the event loop; each has its own source and broker connection.
"""

import asyncio
import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import structlog
from structlog.contextvars import bind_contextvars

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.edge.block_sender import BlockSender
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_plausibility import implausible_settings
from bms_estimator.estimator.stability_conditions import observer_warnings
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.model.payloads.health import RecordingHealth
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.page.page_sink import Pages, PageSink
from bms_estimator.process.runtime import set_level, stop_on_signal
from bms_estimator.process.state_folder import instance_lock, state_folder
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service.alarm_hooks import AlarmHooks
from bms_estimator.service.hook_check import has_relay
from bms_estimator.service.live_loop import ServiceParts, run_estimation_loop
from bms_estimator.service.service_status import ServiceStatus
from bms_estimator.settings.alarm_limits import implausible_limits, monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.exports.influx import InfluxSink
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.mqtt.sink import MqttSink
from bms_estimator.sinks.mqtt.venus_os import configured_limits
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.factory import open_device, pair_with_bms
from bms_estimator.sources.serial.port_list import KnownBoardFile
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import ReadTap
from bms_estimator.store.database import Database
from bms_estimator.store.history import HistorySink
from bms_estimator.store.outbox import Outbox

log = structlog.get_logger(__name__)


async def run_pack_service(
    settings: Settings,
    model: PackModel,
    *,
    sinks: Sequence[Sink] = (),
    tap: ReadTap | None = None,
    stop: asyncio.Event | None = None,
    folder: Path | None = None,
    notifier: SystemdNotifier | None = None,
    pages: Pages | None = None,
) -> Estimator:
    """Run until SIGINT, SIGTERM or SIGHUP.

    Args:
        settings: The pack's settings.
        model: Model of the whole pack.
        sinks: Further sinks, such as the terminal.
        tap: Receives all bytes of the source with their arrival times.
        stop: Event that ends the service. Signals also set it.
        folder: State folder (``state_folder``); None: the state is not saved.
        notifier: Notifies systemd that the loop is ready and alive.
        pages: Page servers of this process; None: new ones.

    Returns:
        The estimator after the last sample.

    Raises:
        UserError: A setting cannot be used.
    """
    stop = stop_on_signal(stop)
    set_level(settings.pack.name, settings.log.level)
    for line in [*implausible_settings(settings, model), *implausible_limits(settings, model)]:
        log.warning("implausible setting", pack=settings.pack.name, reason=line)
    for line in observer_warnings(settings.observer, model):
        log.warning("condition of the observer fails", pack=settings.pack.name, reason=line)
    database = Database(folder / f"{settings.pack.name}.sqlite") if folder else None
    delivery = DeliveryStats(store_trouble=lambda: database.failure_reason) if database else DeliveryStats()
    all_sinks = [*sinks, *export_sinks(settings)]
    if database and settings.store.history_days:
        all_sinks.append(HistorySink(database, days=settings.store.history_days))
    requests = RequestDispatcher(delivery, settings.mqtt.commands if settings.mqtt else ())
    board_file = KnownBoardFile(folder, settings.pack.name) if folder else None
    device = open_device(settings, tap=tap, board_file=board_file)
    board = device if isinstance(device, SerialSource) else None
    source = pair_with_bms(device, settings)
    outbox = Outbox(database, max_messages=settings.store.outbox_messages)
    block_sender = BlockSender(settings.edge, settings.pack.name, folder) if settings.edge and folder else None
    mqtt: MqttSink | None = None
    if settings.mqtt is not None:
        mqtt = MqttSink(
            settings.mqtt,
            settings.pack.name,
            requests,
            delivery,
            outbox,
            sample_period_s=settings.sensor.sample_period_s,
            home_assistant=settings.home_assistant,
            alarms=[each.name for each in monitored_alarms(settings, model)],
            venus_limits=configured_limits(settings.pack) if settings.mqtt.profile == "venus-os" else None,
        )
        all_sinks.insert(0, mqtt)  # so that no other sink delays the messages
    hooks = AlarmHooks(
        settings.alarms.hook,
        settings.pack.name,
        mqtt.publish_raw if mqtt else None,
        board if has_relay(settings) else None,
    )
    if settings.page is not None:
        history = database.path if database and settings.store.history_days else None
        all_sinks.append(
            PageSink(
                pages or Pages(),
                settings.page,
                settings.pack.name,
                history,
                partial(requests.handle, "forecast"),
            )
        )
    async with contextlib.AsyncExitStack() as stack:
        if folder:
            stack.enter_context(instance_lock(folder, settings.pack.name))
        if database:
            await stack.enter_async_context(database)
        await stack.enter_async_context(outbox)
        if block_sender:
            await stack.enter_async_context(block_sender)
        estimator = await run_estimation_loop(
            settings,
            model,
            source=source,
            sinks=all_sinks,
            stop=stop,
            files=StateFiles(folder, settings, model) if folder else None,
            parts=ServiceParts(
                status=ServiceStatus(delivery, device.health, partial(recording_health, tap)),
                requests=requests,
                store_current_zero=device.store_current_zero,
                board_check=board.board_check if board else None,
                notifier=notifier,
                hooks=hooks,
                edge=block_sender,
            ),
        )
    log.info("stopped", pack=settings.pack.name, state="saved" if folder else "not saved")
    return estimator


def export_sinks(settings: Settings) -> list[Sink]:
    """Return the sinks for InfluxDB and Prometheus.

    Raises:
        UserError: A file named in the settings cannot be used.
        ModuleNotFoundError: An optional package is not installed.
    """
    sinks: list[Sink] = [InfluxSink(settings.influx)] if settings.influx else []
    if settings.prometheus:
        from bms_estimator.sinks.exports.prometheus import PrometheusSink  # noqa: PLC0415 - needs an optional package

        sinks.append(PrometheusSink(settings.prometheus))
    return sinks


def recording_health(tap: ReadTap | None) -> RecordingHealth | None:
    """Return the state of a recording; None without one."""
    if not isinstance(tap, CaptureRecorder):
        return None
    return RecordingHealth(on=not tap.ended.done(), bytes=tap.bytes, missed_reads=tap.missed_reads)


async def run_pack_services(packs: Sequence[tuple[Settings, PackModel]]) -> None:
    """Run the services of several packs until SIGINT, SIGTERM or SIGHUP.

    If one service ends, all end, so that systemd restarts all.

    Args:
        packs: Settings and model of each pack.

    Raises:
        UserError: A setting cannot be used (the text begins with the pack's name), or two packs share a name or a port.
    """
    names = [settings.pack.name for settings, _ in packs]
    _require_unique("pack.name", names)
    devices = [each for settings, _ in packs for each in (settings, settings.bms_settings) if each is not None]
    sensors = [device.sensor for device in devices if device.source is None]
    _require_unique("sensor.serial", [sensor.serial for sensor in sensors if sensor.serial])
    # several packs may share the port "auto" if each has the serial number of its board
    _require_unique("sensor.port", [sensor.port for sensor in sensors if sensor.port != "auto" or not sensor.serial])
    _require_unique("prometheus.listen", [settings.prometheus.listen for settings, _ in packs if settings.prometheus])
    for settings, model in packs:  # raises a UserError before any service starts
        with _prefixed_errors(settings):
            monitored_alarms(settings, model)
    stop, notifier, pages = stop_on_signal(), SystemdNotifier(names), Pages()

    async def run_one(settings: Settings, model: PackModel) -> None:
        bind_contextvars(pack=settings.pack.name)
        try:
            with _prefixed_errors(settings):
                folder = state_folder(settings)
                await run_pack_service(settings, model, stop=stop, folder=folder, notifier=notifier, pages=pages)
        finally:
            stop.set()

    results = await asyncio.gather(*(run_one(*pack) for pack in packs), return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result


@contextlib.contextmanager
def _prefixed_errors(settings: Settings) -> Iterator[None]:
    """Prefix the text of a UserError with the pack's name."""
    try:
        yield
    except UserError as error:
        raise type(error)(f"{settings.pack.name}: {error}") from error  # its type determines the exit code


def _require_unique(key: str, values: Sequence[str]) -> None:
    """Check that no two packs share a value.

    Raises:
        UserError: Two packs share a value.
    """
    for value in values:
        if values.count(value) > 1:
            raise UserError(f"{key} = {value}: {values.count(value)} of the packs have it; give each its own")
