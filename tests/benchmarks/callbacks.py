"""The longest callbacks of the service's event loop: while one runs, samples, broker and requests wait."""

import asyncio
import json
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from live import MOSQUITTO, broker, pack_file
from load import pulses
from table import Row

from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard

MEASURE_S = 60.0
RATE_HZ = 100
MOST_S = 5e-3
"""No callback may take longer, of the processor's time: the machine's other work is not ours [s]."""
SERVICE = Path(__file__).with_name("timed_service.py")


def rows() -> Iterator[Row]:
    """A usual board for a minute."""
    if MOSQUITTO is None:
        yield Row("longest callback", "-", "mosquitto is not installed", None)
        return
    block = pulses(int(2 * MEASURE_S) * RATE_HZ, RATE_HZ)
    readings = iter([Reading(*row) for row in zip(block["current_a"], block["voltage_v"], strict=True)])
    with (
        tempfile.TemporaryDirectory() as path,
        VirtualBoard(lambda _: next(readings), rate_hz=RATE_HZ) as board,
        broker(Path(path)) as server,
    ):
        folder = Path(path)
        pack = pack_file(folder, "bench", board.path, RATE_HZ, server, 10)
        longest = asyncio.run(_measure(board, folder / "longest", pack))
    (name, cpu_s, wall_s), *others = longest
    what = f"longest callback of {MEASURE_S:.0f} s at {RATE_HZ} frames/s, processor's time"
    yield Row(what, "at most 5 ms", f"{1e3 * cpu_s:.1f} ms ({1e3 * wall_s:.1f} ms): {name}", cpu_s <= MOST_S)
    for name, cpu_s, wall_s in others:
        yield Row("  next", "-", f"{1e3 * cpu_s:.1f} ms ({1e3 * wall_s:.1f} ms): {name}", None)


async def _measure(board: VirtualBoard, out: Path, pack: Path) -> list[tuple[str, float, float]]:
    running = asyncio.create_task(board.run_for_host())
    with out.with_suffix(".log").open("w") as log:
        command = [sys.executable, SERVICE, out, "run", pack]
        service = await asyncio.create_subprocess_exec(*command, stdout=log, stderr=log)
        while "port opened" not in await asyncio.to_thread(out.with_suffix(".log").read_text):  # noqa: ASYNC110
            await asyncio.sleep(0.1)
        await asyncio.sleep(MEASURE_S)
        service.send_signal(signal.SIGINT)
        await service.wait()
    running.cancel()
    return [tuple(row) for row in json.loads(await asyncio.to_thread(out.read_text))]
