"""Three packs with a fault: a weak cell, a clock in the year 2040, and an edge that is newer than the workers."""

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.edge.block import VERSION, Block, encode
from bms_estimator.fleet.demo.processes import Processes
from bms_estimator.fleet.nats.dead_letters import DeadLetter, read_dead_letters
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, KINDS, SimulatedFleet, table_row

WEAK_CELL, WRONG_CLOCK, NEWER_EDGE = "weak-cell", "clock-2040", "newer-edge"
"""Names of the packs."""
NAMES = (WEAK_CELL, WRONG_CLOCK, NEWER_EDGE)
BLOCKS = 125
"""Number of blocks of ``WEAK_CELL`` and of ``WRONG_CLOCK``. They last two hours, so that at least one hour is complete."""
CELL = 7
"""Number of the weak cell, from 1."""
DEVIATION_V = -0.06
"""Voltage of the weak cell minus the mean of the cells [V]."""
CLOCK_S = datetime(2040, 1, 1, tzinfo=UTC).timestamp()
"""Clock of the edge of ``WRONG_CLOCK`` at its first sample [s since 1970]."""
FUTURE_VERSION = VERSION + 1
"""Version of the undecodable block."""
_VERSION_OFFSET = 4
"""Offset of the version in a block [bytes]."""
_KIND_INDEX = 1
"""Index of the kind of the packs, an NMC battery, whose OCV shows the SOC of a cell."""
_KIND = KINDS[_KIND_INDEX]


def table() -> str:
    """Return the rows of the table of packs."""
    return "".join(f"{table_row(name, _KIND)}\n" for name in NAMES)


async def send_blocks(nc: Client, fleet: SimulatedFleet) -> None:
    """Send the blocks of the three packs, with samples of the first pack of a fleet.

    Raises:
        nats.errors.Error: The server does not store a block.
    """
    for name, data in _blocks(fleet, time.time()):
        await nc.jetstream().publish(subjects.raw(name), data)


async def read_dead_letter(nc: Client) -> DeadLetter | None:
    """Return the dead letter of ``NEWER_EDGE``; None before it is stored."""
    letters = (letter for letter in await read_dead_letters(nc) if letter.pack == NEWER_EDGE)
    return next(letters, None)


async def ask_weak_cell(processes: Processes, folder: Path) -> dict[str, Any]:
    """Return the row of ``WEAK_CELL`` in the answer to the query ``failing``, as soon as an hour of it is on disk.

    The query runs in a process of its own, because DuckDB reports leaks at the end of a process that also uses numba.

    Args:
        processes: Processes of the demo.
        folder: Folder of the Parquet files.
    """

    async def read() -> dict[str, Any] | None:
        answer = await processes.output("ask", "failing", "--folder", folder, "--json")
        return next(
            (row for row in json.loads(answer or "[]") if (row["pack"], row["quantity"]) == (WEAK_CELL, "cell SOC")),
            None,
        )

    await processes.until(lambda: any(folder.glob("date=*/*.parquet")))
    return await processes.poll(read)


def _blocks(fleet: SimulatedFleet, now_s: float) -> Iterator[tuple[str, bytes]]:
    """Yield names and encoded blocks."""
    numbers = np.arange(1, BLOCKS + 1)
    samples = fleet.samples(np.full_like(numbers, _KIND_INDEX), numbers)
    begin_s = now_s - BLOCKS * BLOCK_S
    others_v = -DEVIATION_V / (_KIND.series - 1)
    deviation_v = np.where(np.arange(_KIND.series) == CELL - 1, DEVIATION_V, others_v)
    for number, block in zip(numbers.tolist(), samples, strict=True):
        cells_v = block["voltage_v"][:, None] / _KIND.series + deviation_v
        yield WEAK_CELL, encode(Block(int(begin_s * 1e9), number, 1, now_s, block, cells_v))
        clock_s = CLOCK_S + number * BLOCK_S
        yield WRONG_CLOCK, encode(Block(int(CLOCK_S * 1e9), number, 1, clock_s, block))
    data = encode(Block(int(begin_s * 1e9), 1, 1, now_s, samples[0]))
    yield NEWER_EDGE, data[:_VERSION_OFFSET] + bytes([FUTURE_VERSION]) + data[_VERSION_OFFSET + 1 :]
