"""``bms-estimator demo``: broker, simulated board and service in one terminal."""

import asyncio
import sys
from collections import deque
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import decimal, open_browser, whole
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.demo.demo import run_demo
from bms_estimator.process.runtime import configure_logs, flush_logs
from bms_estimator.service.kernel_warm_up import load_kernels
from bms_estimator.sinks.terminal.sink import LOG_LINES


def demo(
    seconds: Annotated[
        float | None,
        typer.Option(parser=decimal(0.1), help="duration in seconds; default: until Ctrl-C", show_default=False),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            parser=whole(1, 65535),
            help="port of the broker; default: 1883 if it is free, otherwise another port",
            show_default=False,
        ),
    ] = None,
    page_port: Annotated[
        int | None,
        typer.Option(
            parser=whole(1, 65535),
            help="port of the live page; default: 8765 if it is free, otherwise another port",
            show_default=False,
        ),
    ] = None,
    rate_hz: Annotated[int, typer.Option(parser=whole(1, 1000), help="sample rate of the board [Hz]")] = 100,
    speed: Annotated[
        float, typer.Option(parser=decimal(0.1, 10.0), help="speed of the board's clock relative to real time")
    ] = 1.0,
    thesis: Annotated[
        bool,
        typer.Option(
            "--thesis",
            help="run only the method of the thesis, without the identifier: SOC by coulomb counting, a1 to a12 by (3.18), R_s by (4.2)",
        ),
    ] = False,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="open the page in a browser if there is a desktop")
    ] = True,
) -> None:
    """Run an MQTT broker, a simulated board, the live service and its web page in one terminal, until Ctrl-C.

    The simulated board measures a simulated 275 mAh cell under a changing load.
    The service reads the board through a pseudo-terminal, and publishes to the broker on the loopback interface.
    The estimator starts with an SOC that is 20 % too low; with --thesis it starts with the true SOC. The true SOC is shown
    beside the estimate.
    """
    log = deque[str](maxlen=LOG_LINES)
    configure_logs(log if sys.stdout.isatty() else None)
    compile_ahead()
    load_kernels()
    with flush_logs():
        summary = asyncio.run(
            run_demo(
                rate_hz=rate_hz,
                speed=speed,
                port=port,
                page_port=page_port,
                seconds=seconds,
                thesis=thesis,
                log=log,
                opened=open_browser if browser else _ignore_url,
            )
        )
    typer.echo(summary)


def _ignore_url(_url: str) -> None:
    """Do not open a browser."""
