"""Worker processes, blocks for them, and their final states."""

import asyncio
import hashlib
import json
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import aclosing, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
import psutil
from nats.aio.client import Client
from nats.errors import Error as NatsError

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import open_checkpoints
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from tests.command_line import PROGRAM
from tests.fleet.partition_stream import estimates_of
from tests.patience import LONG_S

PERIOD_S = 10.0
"""Interval between two samples [s]."""
PACK_ROW = encode_row(PackSpec(cell="ncr18650", period_s=PERIOD_S))
STORE_ID_NS = 1_790_000_000 * 10**9
"""Creation time of the edges' stores [ns since 1970]."""
SAMPLES = 60
"""Number of samples of a block, which lasts ten minutes."""


def samples(pack: str, number: int) -> np.ndarray:
    """Return the samples of block ``number``. The load steps at a rate that depends on the pack's name, such as p1."""
    time_s = PERIOD_S * (SAMPLES * (number - 1.0) + np.arange(SAMPLES))
    rows = np.zeros(SAMPLES, SAMPLE)
    rows["time_s"] = time_s
    rows["current_a"] = np.where(np.sin(time_s / (200.0 + int(pack[1:]))) > 0.0, 1.5, 0.25)
    rows["voltage_v"] = 3.9 - 0.06 * rows["current_a"] - 5e-6 * time_s
    for name in ("temperature_c", "temperature_min_c", "temperature_max_c"):
        rows[name] = 25.0
    return rows


def block(pack: str, number: int, arrival_s: float = 1.79e9) -> bytes:
    """Return block ``number`` of a pack, encoded."""
    return encode(
        Block(store_created_ns=STORE_ID_NS, number=number, oldest=1, arrival_s=arrival_s, samples=samples(pack, number))
    )


async def load_packs(nc: Client, packs: list[str]) -> PackRegistry:
    """Write packs to the table of packs, and return a registry with them."""
    await write_bucket(nc, subjects.PACKS_BUCKET, dict.fromkeys(packs, PACK_ROW))
    registry = PackRegistry()
    for pack in packs:
        registry.set_row(pack, PACK_ROW)
    return registry


async def until_table(nc: Client, rows: Mapping[str, bytes]) -> None:
    """Wait until the table of packs consists of ``rows``."""
    async with asyncio.timeout(LONG_S):
        while await read_bucket(nc, subjects.PACKS_BUCKET) != rows:  # noqa: ASYNC110 - the server is asked
            await asyncio.sleep(0.1)


async def send(nc: Client, pack: str, data: bytes) -> None:
    """Publish a block until the stream acknowledges it. The stream drops repetitions after a late acknowledgment."""
    headers = {"Nats-Msg-Id": f"{pack} {hashlib.sha256(data).hexdigest()}"}
    deadline = time.monotonic() + LONG_S
    while time.monotonic() < deadline:
        with suppress(NatsError, TimeoutError):
            await nc.jetstream().publish(subjects.raw(pack), data, timeout=1.0, headers=headers)
            return
        await asyncio.sleep(0.05)
    raise AssertionError("the stream does not store the message")


class Process:
    """Worker process, which starts at once and logs to a file."""

    def __init__(
        self, folder: Path, url: str, name: str, *options: object, program: Sequence[object] = (PROGRAM,)
    ) -> None:
        self.name, self._log = name, folder / f"{name}.log"
        command = [*map(str, program), "fleet", "worker", "--server", url, "--name", name, *map(str, options)]
        with self._log.open("a") as log:
            self._process = subprocess.Popen(command, stderr=log)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """Complete lines of its log, without other output on stderr."""
        lines = self._log.read_text().splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("\n")]

    async def logged(self, text: str) -> dict[str, Any]:
        """Wait for a log line whose event contains ``text``, and return it."""

        def find_line() -> dict[str, Any] | None:
            assert self._process.poll() is None, f"the worker has ended: {self._log.read_text()}"
            return next((line for line in self.lines if text in line["event"]), None)

        return await until(find_line, self._log.read_text)

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    async def end(self) -> int:
        """Send SIGTERM and return the exit code."""
        self.signal(signal.SIGTERM)
        return await asyncio.to_thread(self._process.wait, LONG_S)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(LONG_S)


class Fitter:
    """Process ``fleet fit``, which starts at once and logs to a file."""

    def __init__(self, folder: Path, url: str) -> None:
        with (folder / "fit.log").open("a") as log:
            self._process = subprocess.Popen([str(PROGRAM), "fleet", "fit", "--server", url], stderr=log)

    def kill(self) -> None:
        """Send SIGKILL, and wait until the processes that fit have ended too."""
        children = psutil.Process(self._process.pid).children()
        self._process.kill()
        self._process.wait(LONG_S)
        _, remaining = psutil.wait_procs(children, LONG_S)
        assert remaining == []

    def end(self) -> int:
        """Send SIGTERM and return the exit code."""
        self._process.terminate()
        return self._process.wait(LONG_S)


class Heartbeats:
    """Subscriber to heartbeats. ``last`` is the last heartbeat of each worker."""

    def __init__(self, nc: Client) -> None:
        self._nc, self.last = nc, dict[str, Heartbeat]()

    async def __aenter__(self) -> Self:
        await self._nc.subscribe(subjects.worker(), cb=self._receive)
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def _receive(self, message: Any) -> None:
        heartbeat = Heartbeat.model_validate_json(message.data)
        self.last[heartbeat.id] = heartbeat

    def clear(self) -> None:
        self.last.clear()

    async def until(self, condition: Callable[[Mapping[str, Heartbeat]], object]) -> None:
        """Wait until the last heartbeats fulfill a condition."""
        await until(lambda: condition(self.last), lambda: self.last)

    async def until_held(self, partitions: int, *workers: str) -> None:
        """Wait until these workers together hold all partitions, and each holds at least one."""

        def are_held(last: Mapping[str, Heartbeat]) -> bool:
            held = [last[worker].partitions if worker in last else () for worker in workers]
            return all(held) and sorted(number for numbers in held for number in numbers) == list(range(partitions))

        self.clear()
        await self.until(are_held)


async def until(condition: Callable[[], Any], description: Callable[[], object]) -> Any:
    """Wait until ``condition()`` is true and return its value; on a timeout fail with ``description()``."""
    deadline = time.monotonic() + LONG_S
    while time.monotonic() < deadline:
        if result := condition():
            return result
        await asyncio.sleep(0.02)
    raise AssertionError(str(description()))


async def end_states(nc: Client, registry: PackRegistry, partitions: int) -> dict[int, Partition]:
    """Return each partition by its number, restored from its last checkpoint."""
    store = await open_checkpoints(nc, "test")
    partitions_by_number = {}
    for number in range(partitions):
        async with aclosing(store.load(await store.claim(number))) as stored_checkpoints:
            async for _, data in stored_checkpoints:
                partitions_by_number[number] = Partition.restore(number, registry, data)
                break
    return partitions_by_number


def estimated(registry: PackRegistry, pack: str, blocks: int) -> bytes:
    """Return the record of an estimator that has processed blocks 1 to ``blocks`` of a pack in one run."""
    return record_of_run(registry, pack, np.concatenate([samples(pack, number) for number in range(1, blocks + 1)]))


def record_of_run(registry: PackRegistry, pack: str, rows: SampleBlock) -> bytes:
    """Return the record of an estimator that has processed samples of a pack in one run."""
    settings, cell = registry(pack) or (None, None)
    assert settings
    assert cell
    estimator = make_estimator(settings, cell)
    estimator.run(rows)
    return estimates_of(estimator.record)
