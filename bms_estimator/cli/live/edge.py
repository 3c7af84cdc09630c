"""``bms-estimator edge``: service that only sends the raw samples of a pack to a fleet's server.

The command imports kernels only if decoding the board's frames needs them.
"""

import asyncio
from pathlib import Path
from typing import Annotated

import structlog
import typer

from bms_estimator.cli.options.pack_options import PortOverride, with_sensor
from bms_estimator.edge.block_sender import BlockSender
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import (
    configure_logs,
    exit_on_startup_signals,
    flush_logs,
    set_level,
    stop_on_signal,
    until_first_ends,
)
from bms_estimator.process.state_folder import instance_lock, state_folder
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sources.factory import open_device, pair_with_bms
from bms_estimator.sources.serial.port_list import KnownBoardFile
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import LineSource, Source

SOURCE_HUNG_S = 30.0
"""Time after which a source whose task has not run counts as hung [s]."""
MAX_WATCHDOG_S = 5.0
"""Maximum interval between two watchdog notifications [s]."""
REPORT_INTERVAL_S = 3600.0
"""Interval between two log lines about the blocks [s]."""

log = structlog.get_logger(__name__)


async def serve_edge(
    settings: Settings, folder: Path, *, stop: asyncio.Event | None = None, notifier: SystemdNotifier | None = None
) -> None:
    """Send samples until SIGINT, SIGTERM or SIGHUP.

    Args:
        settings: The pack's settings, with ``[edge]``.
        folder: Folder of the blocks.
        stop: Event that ends the service. Signals also set it.
        notifier: Notifies systemd that the loop is ready and alive.

    Raises:
        UserError: A setting cannot be used.
    """
    if settings.edge is None:
        raise UserError('edge: missing: where samples are sent, as in [edge] with url = "mqtt://host:port"')
    stop, name = stop_on_signal(stop), settings.pack.name
    notifier = notifier or SystemdNotifier([name], activity="sending samples of")
    set_level(name, settings.log.level)
    device = open_device(settings, board_file=KnownBoardFile(folder, name))
    source = pair_with_bms(device, settings)
    with instance_lock(folder, name):
        async with BlockSender(settings.edge, name, folder) as sender, source:
            notifier.ready(name)
            try:
                await until_first_ends(
                    _send_samples(source, sender),
                    _notify_alive(device, sender, notifier, name),
                    _log_blocks(sender),
                    stop.wait(),
                )
            finally:
                notifier.stopping(name)


async def _send_samples(source: Source, sender: BlockSender) -> None:
    async for received in source:
        sender.take(received.samples, received.cells_v)
        await asyncio.sleep(0)  # a source that always has samples must not starve the sender


async def _notify_alive(
    source: SerialSource | LineSource, sender: BlockSender, notifier: SystemdNotifier, name: str
) -> None:
    """Notify the watchdog while the source's task runs, and report the status."""
    sent_status = ""
    while True:
        if source.health().task_idle_s <= SOURCE_HUNG_S:
            notifier.alive(name)
        status = (
            f"no samples: {source.silence_reason}"
            if source.silence_reason
            else f"{sender.queue.waiting} blocks not sent"
        )
        if status != sent_status:
            notifier.status(name, status)
            sent_status = status
        # three notifications within the watchdog's timeout; 0: no watchdog
        await asyncio.sleep(min(MAX_WATCHDOG_S, notifier.watchdog_s / 3.0 or MAX_WATCHDOG_S))


async def _log_blocks(sender: BlockSender) -> None:
    while True:
        await asyncio.sleep(REPORT_INTERVAL_S)
        log.info("blocks of samples", **sender.health().model_dump())


def edge(
    pack: Annotated[Path, typer.Argument(help="settings file of the pack, with a section \\[edge]")] = Path(
        "pack.toml"
    ),
    port: PortOverride = None,
) -> None:
    """Send a pack's raw samples to a fleet server until SIGINT, SIGTERM or SIGHUP.

    The fleet's workers estimate SOC and parameters from the samples.
    Samples are stored on disk until the server confirms them (docs/fleet/edge.md).
    """
    settings = with_sensor(load_settings(pack), port=port)
    configure_logs()
    with exit_on_startup_signals(), flush_logs():
        asyncio.run(serve_edge(settings, state_folder(settings)))
