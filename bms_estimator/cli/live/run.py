"""``bms-estimator run``: service of one or several packs."""

import asyncio
import contextlib
import sys
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import structlog
import typer

from bms_estimator.cli.options.pack_options import PortOverride, load_pack, with_broker, with_sensor
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.process.runtime import configure_logs, exit_on_startup_signals, flush_logs
from bms_estimator.process.state_folder import state_folder
from bms_estimator.service.kernel_warm_up import load_kernels
from bms_estimator.service.pack_service import run_pack_service, run_pack_services
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.terminal.sink import LOG_LINES, TerminalSink
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder


def run(
    packs: Annotated[
        list[Path] | None, typer.Argument(help="settings files, one for each pack", show_default="pack.toml")
    ] = None,
    port: PortOverride = None,
    mqtt: Annotated[
        str | None, typer.Option(help="MQTT broker that replaces mqtt.url of the settings, mqtt://host:port")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="also record the device's raw bytes in this new file", show_default=False)
    ] = None,
    view: Annotated[
        bool | None,
        typer.Option("--view/--no-view", help="show a live view on stdout; default: only if stdout is a terminal"),
    ] = None,
) -> None:
    """Run the live service: estimate from a BMS, battery monitor or sensor board, and publish the estimates.

    The service runs until SIGINT, SIGTERM or SIGHUP.
    One process may serve several packs, each with its own device and broker connection.
    """
    paths = packs or [Path("pack.toml")]
    apply_options = partial(_with_options, port=port, mqtt=mqtt)
    loaded = [(apply_options(settings), model) for settings, model in map(load_pack, paths)]
    with exit_on_startup_signals():
        if len(loaded) == 1:
            _run_one(*loaded[0], record, view=_stdout_is_terminal() if view is None else view)
        else:
            if port or record or view:
                raise UserError("--port, --record and --view require a single pack")
            _run_several(loaded)


def _stdout_is_terminal() -> bool:
    return sys.stdout is not None and sys.stdout.isatty()  # None if the process was started without a stdout


def _with_options(settings: Settings, port: str | None, mqtt: str | None) -> Settings:
    if mqtt:
        settings = with_broker(settings, mqtt)
    return with_sensor(settings, port=port)


def _run_several(packs: Sequence[tuple[Settings, PackModel]]) -> None:
    configure_logs()
    with flush_logs():
        _load_kernels()
        asyncio.run(run_pack_services(packs))


def _run_one(settings: Settings, model: PackModel, record: Path | None, *, view: bool) -> None:
    log: deque[str] = deque(maxlen=LOG_LINES)
    configure_logs(log if view and _stdout_is_terminal() else None)
    recorder = (
        CaptureRecorder(record, make_header(settings.sensor, settings.source)) if record else contextlib.nullcontext()
    )
    sinks = [TerminalSink(log=log)] if view else []
    with flush_logs(), recorder as tap:
        _load_kernels()
        service = run_pack_service(settings, model, sinks=sinks, tap=tap, folder=state_folder(settings))
        asyncio.run(service)


def _load_kernels() -> None:
    compile_ahead(structlog.get_logger(__name__).info)
    load_kernels()
