"""``bms-estimator demo``: broker, board and the real service in one terminal."""

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import typer
from rich.console import Console

import bms_estimator
from bms_estimator.cli.run import LOG_LINES
from bms_estimator.demo.broker import DemoBroker
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Snapshot
from bms_estimator.model.settings import (
    MqttSettings,
    ObserverSettings,
    PackSettings,
    PublishSettings,
    SensorSettings,
    Settings,
)
from bms_estimator.service.interrupt import stop_on_signal
from bms_estimator.service.live import new_estimator
from bms_estimator.service.logs import configure_logs
from bms_estimator.service.serve import serve
from bms_estimator.sinks.console import ConsoleSink
from bms_estimator.sources.firmware_board import FirmwareBoard
from bms_estimator.sources.frames import FrameDecoder
from bms_estimator.sources.simulated_pack import SimulatedPack, random_steps
from bms_estimator.sources.virtual_board import VirtualBoard

FIRMWARE_BUILD = Path(bms_estimator.__file__).parents[1] / "firmware" / "build"
CELL = "chen_mora"
LOAD_A = 1.0
"""Steps up to four times the capacity per hour: SOC falls by a percent in half a minute [A]."""
START_SOC = 0.9
RESOLUTION_V = 5e-3
"""Of a mean of many noisy conversions, a fifth of the converter's step [V]."""
PUBLISH_RATE_HZ = 4.0
LAMBDA = 1e4
"""Of the gain (3.10): what takes k hours with the usual 1 is to be seen within minutes."""


def demo(
    seconds: Annotated[float | None, typer.Option(min=0.1, help="else until Ctrl-C", show_default=False)] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="of the broker; else 1883, or a free one", show_default=False)
    ] = None,
    rate_hz: Annotated[int, typer.Option(min=1, max=1000, help="samples per second")] = 100,
    firmware: Annotated[
        Path | None, typer.Option(help="folder of the built firmware and its simulator", show_default=False)
    ] = None,
    python_board: Annotated[bool, typer.Option("--python-board", help="the firmware's stand-in in Python")] = False,
) -> None:
    """Broker, board and service in one terminal, until Ctrl-C.

    A simulated 275 mAh cell under a changing load is at the pins of a board: the real firmware in simavr where that is
    built (make firmware), else its stand-in in Python. The real service reads it from a pseudo-terminal and publishes
    to a broker of its own on the loopback.
    """
    build = None if python_board else _build(firmware)
    console, log = Console(), deque[str](maxlen=LOG_LINES)
    configure_logs(log if console.is_terminal else None)
    typer.echo(asyncio.run(_demo(console, log, build, rate_hz=rate_hz, port=port, seconds=seconds)))


def _build(given: Path | None) -> Path | None:
    """Folder of the built firmware; None where it is not built and none was asked for.

    Raises:
        UserError: Nothing is built in the folder that was given.
    """
    folder = FIRMWARE_BUILD if given is None else given
    if FirmwareBoard.is_built(folder):
        return folder
    if given is not None:
        raise UserError(f"--firmware {given}: no built firmware and simulator there; make firmware, or --python-board")
    return None


async def _demo(
    console: Console, log: deque[str], build: Path | None, *, rate_hz: int, port: int | None, seconds: float | None
) -> str:
    """Run until a signal or the time's end. Returns what came of it, in a line."""
    stop = stop_on_signal()
    cell = load_cell(CELL)
    _compile(console, cell)
    totals = Totals()
    async with DemoBroker(port) as broker, _board(build, cell, rate_hz) as board:
        hint = f"{board.name}; in a second terminal: {broker.look_command}"
        if not console.is_terminal:
            console.print(hint, soft_wrap=True, highlight=False, markup=False)
        settings = _settings(board.path, broker.url, rate_hz)
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, stop.set)
        await serve(settings, cell, sinks=[ConsoleSink(console, log=log, hint=hint), totals], stop=stop)
    return totals.summary()


def _compile(console: Console, cell: CellModel) -> None:
    """Have all kernels ready, so that nothing waits for them once the board runs."""
    with console.status("compiling kernels: some seconds at the first start, cached afterwards"):
        new_estimator(Settings(), cell)
        FrameDecoder()


class Board(NamedTuple):
    """A board that runs."""

    name: str
    path: str
    """Of its pseudo-terminal."""


@asynccontextmanager
async def _board(build: Path | None, cell: CellModel, rate_hz: int) -> AsyncIterator[Board]:
    """The firmware in its simulator where it is built, else the board in Python."""
    pack = SimulatedPack(cell, random_steps(LOAD_A), soc=START_SOC)
    if build is None:
        with VirtualBoard(pack, rate_hz=rate_hz) as virtual:
            async with _running(virtual.run()):
                yield Board("board in Python", virtual.path)
    else:
        async with FirmwareBoard(build, pack) as simulated, _running(simulated.run()):
            yield Board("firmware in simavr", simulated.path)


@asynccontextmanager
async def _running(work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def _settings(path: str, url: str, rate_hz: int) -> Settings:
    return Settings(
        pack=PackSettings(name="demo", cell=CELL),
        sensor=SensorSettings(port=path, sample_rate_hz=rate_hz, voltage_resolution_v=RESOLUTION_V),
        observer=ObserverSettings.model_validate({"lambda": LAMBDA}),
        publish=PublishSettings(rate_hz=PUBLISH_RATE_HZ),
        mqtt=MqttSettings(url=url),
    )


class Totals:
    """A sink that remembers the first and the last of what there was."""

    def __init__(self) -> None:
        self._first: Snapshot | None = None
        self._last: Snapshot | None = None
        self._started_s = time.monotonic()

    async def __aenter__(self) -> Self:
        """Nothing to open."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Nothing to close."""

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot."""
        if snapshot.estimate is not None:
            self._first, self._last = self._first or snapshot, snapshot

    def summary(self) -> str:
        """The run in a line."""
        first, last = (s.estimate if s else None for s in (self._first, self._last))
        elapsed_s = time.monotonic() - self._started_s
        if first is None or last is None:
            return f"{elapsed_s:.1f} s, no sample came"
        return (
            f"{elapsed_s:.1f} s: {last.frames_received:,} frames, {last.frames_lost} lost, {last.crc_errors} CRC "
            f"errors; SOC {first.soc_percent:.2f} to {last.soc_percent:.2f} %, margin {last.stability_margin:.4f}, "
            f"{'lock' if last.lock else 'no lock'}"
        )
