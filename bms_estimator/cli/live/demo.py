"""``bms-estimator demo``: broker, board and the real service in one terminal."""

import asyncio
import sys
from collections import deque
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.compile_progress import show_compile_progress
from bms_estimator.cli.options.number_options import decimal, whole
from bms_estimator.cli.options.page_options import open_browser
from bms_estimator.demo.board import find_build
from bms_estimator.demo.demo import run_demo
from bms_estimator.process.log_setup import configure_logs, flush_logs
from bms_estimator.service.kernel_warm_up import load_kernels
from bms_estimator.sinks.terminal.panels import LOG_LINES


def demo(
    seconds: Annotated[
        float | None, typer.Option(parser=decimal(0.1), help="else until Ctrl-C", show_default=False)
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(parser=whole(1, 65535), help="of the broker; else 1883, or a free one", show_default=False),
    ] = None,
    page_port: Annotated[
        int | None,
        typer.Option(parser=whole(1, 65535), help="of the live page; else 8765, or a free one", show_default=False),
    ] = None,
    rate_hz: Annotated[int, typer.Option(parser=whole(1, 1000), help="samples per second")] = 100,
    speed: Annotated[
        float, typer.Option(parser=decimal(0.1, 10.0), help="of the board's time, as far as the machine keeps up")
    ] = 1.0,
    firmware: Annotated[
        Path | None, typer.Option(help="folder of the built firmware and its simulator", show_default=False)
    ] = None,
    python_board: Annotated[bool, typer.Option("--python-board", help="the firmware's stand-in in Python")] = False,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="open the page where there is a desktop")
    ] = True,
) -> None:
    """Broker, board, service and live page in one terminal, until Ctrl-C.

    A simulated 275 mAh cell under a changing load is at the pins of a board: the real firmware in simavr where that is
    built (make firmware), else its stand-in in Python. The real service reads it from a pseudo-terminal and publishes
    to a broker of its own on the loopback. Its initial SOC is 20 % wrong; the true SOC is shown beside the estimate.
    """
    build = None if python_board else find_build(firmware)
    log = deque[str](maxlen=LOG_LINES)
    configure_logs(log if sys.stdout.isatty() else None)
    with show_compile_progress():
        load_kernels()
    with flush_logs():
        totals = asyncio.run(
            run_demo(
                build,
                rate_hz=rate_hz,
                speed=speed,
                port=port,
                page_port=page_port,
                seconds=seconds,
                log=log,
                opened=open_browser if browser else _leave,
            )
        )
    typer.echo(totals)


def _leave(_url: str) -> None:
    """Open nothing."""
