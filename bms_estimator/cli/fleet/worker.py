"""``bms-estimator fleet worker``: estimates of the packs of some partitions."""

import asyncio
import os
import re
import socket
from typing import Annotated

import structlog
import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.fleet.worker.kernel_warm_up import load_fleet_kernels
from bms_estimator.fleet.worker.worker import CHECKPOINT_S, Options, work
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import configure_logs, exit_on_startup_signals, flush_logs, stop_on_signal

_MAX_NAME_LENGTH = 64
_VALID_NAME = re.compile(f"[A-Za-z0-9_-]{{1,{_MAX_NAME_LENGTH}}}")


def worker(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    name: Annotated[
        str | None,
        typer.Option(help="name of the worker, which must be unique", show_default="host name and process number"),
    ] = None,
    checkpoint_s: Annotated[
        float, typer.Option(min=1.0, help="interval in seconds between two checkpoints of the same partition")
    ] = CHECKPOINT_S,
) -> None:
    """Run a worker, which estimates the packs of some partitions, until SIGINT, SIGTERM or SIGHUP.

    The packs of a tenant are divided into partitions, which its workers share among themselves.
    """
    options = Options(server, _worker_name(name), creds, ca, checkpoint_s)
    configure_logs()
    with exit_on_startup_signals(), flush_logs():
        compile_ahead(structlog.get_logger(__name__).info)
        load_fleet_kernels()
        asyncio.run(_work(options))


async def _work(options: Options) -> None:
    await work(options, stop_on_signal())


def _worker_name(name: str | None) -> str:
    if name is None:
        default = re.sub(r"[^A-Za-z0-9_-]", "-", f"{socket.gethostname()}-{os.getpid()}")
        return default[-_MAX_NAME_LENGTH:]  # the process number at its end makes it unique
    if not _VALID_NAME.fullmatch(name):
        raise UserError(f"--name {name}: must be at most {_MAX_NAME_LENGTH} letters, digits, - and _")
    return name
