"""Telemetry platform: batches of a pack's samples, and a process of ``fleet ingest``."""

import asyncio
import contextlib
import json
import sqlite3
import struct
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bms_estimator.fleet.ingest.ingest import ingest
from bms_estimator.fleet.ingest.ingest_store import FILE
from bms_estimator.fleet.ingest.startup import Options
from bms_estimator.model.arrays import SampleBlock
from tests.command_line import PROGRAM, running_program
from tests.fleet.workers import SAMPLES, samples, until

START_S = 1_700_000_000.0
"""Time of the first sample [s since 1970]."""
ALIGNMENT = 8
"""Alignment of the columns in an Arrow record batch [bytes]."""


def samples_of(pack: str, count: int) -> SampleBlock:
    """Return the first samples of a pack, with times since 1970. The load depends on the pack's name, such as p1."""
    blocks = [samples(pack, number) for number in range(1, -(-count // SAMPLES) + 1)]
    rows = np.concatenate(blocks)[:count]
    rows["time_s"] += START_S
    return rows


def columns_of(rows: SampleBlock) -> dict[str, list[float]]:
    """Return samples as columns."""
    return {name: rows[name].tolist() for name in ("time_s", "current_a", "voltage_v", "temperature_c")}


def json_batch(rows: SampleBlock, **more: Any) -> bytes:
    """Return a batch of samples in JSON."""
    return json.dumps(columns_of(rows) | more).encode()


def arrow_batch(rows: SampleBlock) -> bytes:
    """Return a batch of samples as an Arrow IPC stream."""
    return arrow_bytes(pa.table(columns_of(rows)))


def arrow_bytes(table: pa.Table, **options: Any) -> bytes:
    """Return a table as an Arrow IPC stream."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema, options=pa.ipc.IpcWriteOptions(**options)) as writer:
        writer.write_table(table)
    return sink.getvalue().to_pybytes()


def arrow_with_shared_columns(names: list[str], rows: int) -> bytes:
    """Return an Arrow IPC stream whose columns of int8 all refer to the same bytes."""
    ones = pa.array(np.ones(rows, np.int8))
    data = arrow_bytes(pa.table(dict.fromkeys(names, ones)))
    size = -(-rows // ALIGNMENT) * ALIGNMENT
    for number in range(1, len(names)):
        buffers = struct.pack("<4q", number * size, 0, number * size, rows)  # validity and values: offset and length
        data = data.replace(buffers, struct.pack("<4q", 0, 0, 0, rows))
    body = len(names) * size
    end = data.index(struct.pack("<q", body))
    data = data[:end] + struct.pack("<q", size) + data[end + 8 :]
    return data[: -8 - body + size] + data[-8:]  # the last 8 bytes end the stream


def options(folder: Path, url: str, **more: Any) -> Options:
    """Return the options of ``fleet ingest`` with their defaults."""
    return Options(url, folder / "blocks", block_s=60.0, buffer_bytes=1 << 30, **more)


@contextlib.asynccontextmanager
async def ingesting(folder: Path, url: str, **more: Any) -> AsyncIterator[None]:
    """Receive batches in this process, and stop at the end, so that open blocks are sent."""
    stop = asyncio.Event()
    task = asyncio.create_task(ingest(options(folder, url, **more), stop))
    try:
        yield
    finally:
        stop.set()
        await task


def select(folder: Path, query: str) -> list[int]:
    """Return a column of the stored blocks' database; an empty list without a readable database."""
    address = f"file:{folder / 'blocks' / FILE}?mode=ro"
    with (
        contextlib.suppress(sqlite3.DatabaseError),
        contextlib.closing(sqlite3.connect(address, uri=True)) as database,
    ):
        return [value for (value,) in database.execute(query)]
    return []


async def until_stored(folder: Path, blocks: int) -> None:
    """Wait until ``blocks`` blocks of the only pack were completed."""
    await until(lambda: select(folder, "SELECT next FROM pack") == [blocks + 1], lambda: "the blocks are not stored")


class IngestProcess:
    """Process of ``fleet ingest``."""

    def __init__(self, process: Any, log: Path, begin: int) -> None:
        self.process, self._log, self._begin = process, log, begin

    @property
    def lines(self) -> list[dict[str, Any]]:
        """Complete lines of its log."""
        lines = self._log.read_text()[self._begin :].splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("\n")]

    async def logged(self, event: str, **values: Any) -> dict[str, Any]:
        """Wait for a log line with an event and values, and return it."""

        def find_line() -> dict[str, Any] | None:
            found = (line for line in self.lines if line["event"] == event and values.items() <= line.items())
            return next(found, None)

        return await until(find_line, self._log.read_text)

    async def end(self) -> int:
        """End the process by SIGTERM, and return its exit code."""
        self.process.terminate()
        return await self.process.wait()


@contextlib.asynccontextmanager
async def running_ingest(folder: Path, url: str, *arguments: object) -> AsyncIterator[IngestProcess]:
    """Run ``fleet ingest``, and kill it at the end."""
    log = folder / "ingest.log"
    with log.open("a") as stderr:
        begin = stderr.tell()
        command = (PROGRAM, "fleet", "ingest", "--server", url, "--folder", folder / "blocks", *arguments)
        async with running_program(*command, stderr=stderr) as process:
            yield IngestProcess(process, log, begin)
