"""Attack with the token of one edge device, and its effect on the latency of estimates of the tenant's other packs.

make load ARGS="--minutes 0 --hours 0 --attack-s 30"

The server is real, and one worker runs as a process. Honest edges send a block each half second. The attacker is a process
that sends as fast as the server accepts its messages. The latency of a block is the time from before its publication until
its state arrives.
"""

import asyncio
import contextlib
import json
import multiprocessing as mp
import tempfile
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from aiomqtt import Client as Edge
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import MAX_BLOCK_BYTES, RAW_BYTES
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.benchmarks.table import Row
from tests.fleet.tenant import Tenant, heavy_block, mqtt_client, numbered, one_tenant
from tests.fleet.workers import PACK_ROW, PERIOD_S, SAMPLES, Heartbeats, Process, block
from tests.patience import until

ATTACKER = "attacker"
PACKS = [f"p{i}" for i in range(20)]
PARTITIONS = 4
BLOCK_PERIOD_S = 0.5
"""Interval between two blocks of an honest pack [s]."""
MAX_RATIO = 15.0
"""Maximum permitted ratio of the longest latency in an attack to the longest latency without an attack."""
IN_FLIGHT = 64
"""Maximum number of the attacker's unacknowledged messages."""
ATTACKS = {
    "blocks of 65,535 samples": lambda: heavy_block(65_535, 1.0),
    "blocks of 20,000 samples, 1 Hz": lambda: heavy_block(20_000, 1.0, store=2),
    "junk of 256 KiB": lambda: bytes(MAX_BLOCK_BYTES - 1024),
}
"""Name of each attack, and function that returns its message."""


def run_attacker(port: int, token: str, name: str) -> None:
    """Send the message of the attack ``name`` until the process is killed."""
    asyncio.run(_flood(port, token, ATTACKS[name]()))


async def _flood(port: int, token: str, data: bytes) -> None:
    last_number = 0
    async with mqtt_client(port, token) as edge:
        edge.pending_calls_threshold = IN_FLIGHT  # aiomqtt would warn about so many pending messages
        while True:
            numbers = range(last_number + 1, last_number + IN_FLIGHT + 1)
            last_number += IN_FLIGHT
            await asyncio.gather(*(edge.publish(f"raw/{ATTACKER}", numbered(data, n), qos=1) for n in numbers))


@contextlib.contextmanager
def attack_in_background(tenant: Tenant, name: str) -> Iterator[None]:
    """Run an attack while the context lasts."""
    arguments = tenant.cluster.mqtt_port, tenant.token(ATTACKER), name
    process = mp.get_context("spawn").Process(target=run_attacker, args=arguments, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


@dataclass
class Latencies:
    """Latencies of the blocks of the honest packs.

    Attributes:
        published_s: Monotonic time of the publication of each block without a state [s], by pack and time of its last sample.
        latencies_s: Latencies of the blocks whose state has arrived [s].
    """

    published_s: dict[tuple[str, float], float] = field(default_factory=dict)
    latencies_s: list[float] = field(default_factory=list)

    async def record_state(self, message: Msg) -> None:
        """Record the latency of the block whose state was published."""
        key = message.subject.split(".")[1], json.loads(message.data)["board_time_s"]
        if key in self.published_s:
            self.latencies_s.append(time.monotonic() - self.published_s.pop(key))

    async def wait_for_all(self) -> None:
        """Wait until a state has arrived for every block."""
        await until(lambda: not self.published_s)

    def summarize(self) -> tuple[float, float, int]:
        """Return median [s], maximum [s] and number of the latencies, and delete them."""
        latencies_s, self.latencies_s = self.latencies_s, []
        return float(np.median(latencies_s)), max(latencies_s), len(latencies_s)


@dataclass
class HonestEdges:
    """Edges of the honest packs.

    Attributes:
        edges: Connections by pack.
        latencies: Latencies of their blocks.
        number: Number of the last block, which is the same for all packs.
    """

    edges: dict[str, Edge]
    latencies: Latencies
    number: int = 0

    async def send(self, seconds: float) -> tuple[float, float, int]:
        """Send blocks for this duration; return the result of ``Latencies.summarize``."""
        end_s = time.monotonic() + seconds
        while True:
            self.number += 1
            await asyncio.gather(*(self._send(pack, edge) for pack, edge in self.edges.items()))
            if time.monotonic() >= end_s:
                break
        await self.latencies.wait_for_all()
        return self.latencies.summarize()

    async def _send(self, pack: str, edge: Edge) -> None:
        last_s = PERIOD_S * (SAMPLES * self.number - 1)
        self.latencies.published_s[pack, last_s] = time.monotonic()
        await edge.publish(f"raw/{pack}", block(pack, self.number), qos=1)
        await asyncio.sleep(BLOCK_PERIOD_S)


@contextlib.asynccontextmanager
async def connect_honest_edges(tenant: Tenant, reader: Client) -> AsyncIterator[HonestEdges]:
    """Connect the honest packs."""
    latencies = Latencies()
    await reader.subscribe(subjects.published("*", "state"), cb=latencies.record_state)
    async with AsyncExitStack() as stack:
        yield HonestEdges({pack: await stack.enter_async_context(tenant.edge(pack)) for pack in PACKS}, latencies)


async def measure(folder: Path, seconds: float) -> list[Row]:
    """Measure the latencies without an attack and with each attack."""
    with one_tenant(folder) as tenant:
        await tenant.make_streams(PARTITIONS, RAW_BYTES)
        admin, reader = await tenant.program(Role.ADMIN), await tenant.program(Role.READER)
        await write_bucket(admin, subjects.PACKS_BUCKET, dict.fromkeys([*PACKS, ATTACKER], PACK_ROW))
        worker = Process(folder, tenant.cluster.url, "w", "--creds", tenant.file(Role.WORKER))
        try:
            async with Heartbeats(reader) as heartbeats, connect_honest_edges(tenant, reader) as packs:
                await heartbeats.until_held(PARTITIONS, "w")
                await packs.send(2.0)  # not measured: the worker loads its kernels
                without_attack = await packs.send(seconds)
                rows = [Row(f"{len(PACKS)} packs of a fleet, without an attack", "", _format(without_attack), None)]
                for name in ATTACKS:
                    with attack_in_background(tenant, name):
                        result = await packs.send(seconds)
                    ratio = result[1] / without_attack[1]
                    measured = f"{_format(result)}: {result[0] / without_attack[0]:.1f} and {ratio:.1f} times as long"
                    target = f"longest at most {MAX_RATIO:g} times as long"
                    rows.append(Row(f"  one edge sends {name}", target, measured, ratio < MAX_RATIO))
                rows.append(await _stream_row(reader, packs.number))
        finally:
            worker.kill()
            await admin.close()
            await reader.close()
        return rows


def _format(result: tuple[float, float, int]) -> str:
    median_s, longest_s, count = result
    return f"{1e3 * median_s:.0f} ms, longest {1e3 * longest_s:.0f} ms, {count} blocks"


async def _stream_row(reader: Client, number: int) -> Row:
    """Return the row that compares the honest packs' blocks in the stream with the number of sent blocks."""
    info = await reader.jetstream().stream_info(subjects.RAW_STREAM, subjects_filter=">")
    counts = dict(info.state.subjects or {})
    stored = sum(count for subject, count in counts.items() if not subject.endswith(f".{ATTACKER}"))
    sent_blocks, of_attacker = number * len(PACKS), sum(counts.values()) - stored
    return Row(
        "  their blocks in the stream",
        "all",
        f"{stored:,} of {sent_blocks:,}, {of_attacker:,} of the attacker",
        stored == sent_blocks,
    )


def rows(seconds: float) -> Iterator[Row]:
    """Measure the latencies without an attack and with each attack, each for ``seconds`` [s]."""
    load_kernels()  # compiled once, not by the worker
    with tempfile.TemporaryDirectory() as folder:
        yield from asyncio.run(measure(Path(folder), seconds))
