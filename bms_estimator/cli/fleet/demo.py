"""``bms-estimator fleet demo``: a fleet in one terminal."""

import asyncio
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import decimal, open_browser, whole
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.fleet.demo.demo import Demo, run_demo
from bms_estimator.fleet.demo.processes import free_port
from bms_estimator.fleet.worker.kernel_warm_up import load_fleet_kernels
from bms_estimator.process.runtime import stop_on_signal


def demo(
    packs: Annotated[int, typer.Option(parser=whole(1, 100_000), help="number of simulated packs")] = 1000,
    seconds: Annotated[
        float, typer.Option(parser=decimal(3.0), help="duration in seconds for which the edges send samples")
    ] = 40.0,
    page_port: Annotated[
        int | None,
        typer.Option(parser=whole(1, 65535), help="port of the page; default: a free port", show_default=False),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="open the page in a browser if there is a desktop")
    ] = True,
) -> None:
    """Run a server, simulated packs, two workers and the fleet's page in one terminal for a minute.

    The output explains each step. Three packs send faulty data, which the fleet must detect.
    One of the two workers is killed, and the other takes over its packs.
    The output ends with a table of measured results.
    All parts are processes on the loopback interface, with free ports and a temporary folder.
    """
    compile_ahead()
    load_fleet_kernels()
    with tempfile.TemporaryDirectory(prefix="fleet-demo-") as folder:
        opened = open_browser if browser else _ignore_url
        asyncio.run(_run(Demo(packs, seconds, page_port or free_port(), Path(folder), typer.echo, opened)))


async def _run(demo: Demo) -> None:
    await run_demo(demo, stop_on_signal())


def _ignore_url(_url: str) -> None:
    """Do not open a browser."""
