"""Benchmark of a fleet of processes: server, workers and simulated edge devices. ``make fleet ARGS="--packs 10000"``.

The lag is the time from the arrival of a block's last sample at the edge to the arrival of ``bms.<pack>.state`` at a listener.
Quantiles are computed over ``OBSERVED_PACKS`` packs. The maximum over all packs comes from the heartbeats of the workers. The first
minutes, in which every pack starts, are not measured.
"""

import argparse
import asyncio
import json
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from nats.aio.msg import Msg
from rich.console import Console
from rich.table import Table

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.fleet.worker.worker import CHECKPOINT_S
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.benchmarks.fleet.rig import Rig, cpu_s, create_streams, rig, rss_mib
from tests.patience import LONG_S, until

SEED, DAY_S, PARTITIONS = 1, 86_400.0, 64
"""Seed of the simulated packs, seconds of a day, and number of partitions of the stream."""
OBSERVED_PACKS = 256
"""Number of packs whose estimates are received; they are evenly spread over the fleet."""


@dataclass
class ReceivedMessages:
    """Messages received in the measured time.

    Attributes:
        lags_s: Lags of the estimates of the observed packs [s].
        worst_s: Maximum lag of all blocks, by the heartbeats [s].
        within: Number of estimates, by whether the true SOC is within two standard deviations.
        workers: Last heartbeat by name of the worker.
    """

    lags_s: list[float] = field(default_factory=list)
    worst_s: float = 0.0
    within: Counter[bool] = field(default_factory=Counter)
    workers: dict[str, Heartbeat] = field(default_factory=dict)

    @property
    def blocks(self) -> int:
        """Number of blocks processed by all workers."""
        return sum(worker.blocks for worker in self.workers.values())

    def total(self, counter: str) -> int:
        """Return the sum of a counter over all workers."""
        return sum(worker.counters.get(counter, 0) for worker in self.workers.values())


def main() -> None:
    """Measure each number of packs, and print a table."""
    arguments = _arguments()
    load_kernels()  # compiled once, not by each worker
    rows = [asyncio.run(_measure(packs, arguments)) for packs in arguments.packs]
    table = Table(title=f"a fleet on {psutil.cpu_count()} cores, {arguments.workers} workers, {arguments.minutes} min")
    for name in ("", *(f"{packs:,}" for packs in arguments.packs)):
        table.add_column(name, justify="right" if name else "left")
    for name in rows[0]:
        table.add_row(name, *(row[name] for row in rows))
    Console(width=120).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(dict(zip(map(str, arguments.packs), rows, strict=True)), indent=1))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make fleet ARGS=...", description=__doc__)
    parser.add_argument("--packs", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--minutes", type=float, default=3.0, help="measured time [min]")
    parser.add_argument("--warm-up", type=float, default=2.0, help="time before the measurement [min]")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--speed", type=float, default=1.0, help="speed of the packs relative to real time")
    parser.add_argument("--fits", action="store_true", help="run also `fleet fit`")
    parser.add_argument("--json", type=Path, help="file to which the rows are also written")
    return parser.parse_args()


async def _measure(packs: int, arguments: argparse.Namespace) -> dict[str, str]:
    with tempfile.TemporaryDirectory() as folder, rig(Path(folder), nodes=1, partitions=PARTITIONS) as fleet_rig:
        await create_streams(fleet_rig, partitions=PARTITIONS)
        return await _run(fleet_rig, packs, arguments)


async def _run(fleet_rig: Rig, packs: int, arguments: argparse.Namespace) -> dict[str, str]:
    minutes = arguments.warm_up + arguments.minutes
    # faster packs begin in the past, so that no block is from the future
    begin_s = int(time.time() - 60.0 * minutes * max(arguments.speed - 1.0, 0.0))
    fleet = SimulatedFleet(packs, seed=SEED, begin_ns=begin_s * 10**9)
    load_begin_s = time.monotonic()
    await asyncio.to_thread(fleet_rig.load, fleet)
    load_time_s = time.monotonic() - load_begin_s
    names = [fleet_rig.start_worker(checkpoint_s=CHECKPOINT_S) for _ in range(arguments.workers)]
    received = await _listen(fleet_rig, fleet)
    await until(lambda: len(received.workers) == len(names))
    begin = datetime.fromtimestamp(begin_s, UTC).replace(tzinfo=None).isoformat()
    blocks = round(minutes * arguments.speed) + 1
    edges = fleet_rig.simulate(packs, seed=SEED, begin=f"{begin}", speed=arguments.speed, blocks=blocks)
    fits = [fleet_rig.start_fits()] if arguments.fits else []
    await asyncio.sleep(60.0 * arguments.warm_up)
    pids = (
        {name: fleet_rig.workers[name].pid for name in fits}
        | {"server": fleet_rig.engine.pid(0), "edges": edges.pid}
        | {name: fleet_rig.workers[name].pid for name in names}
    )
    cpu_before_s = {name: cpu_s(pid) for name, pid in pids.items()}
    idle_before_s = psutil.cpu_times().idle
    measure_begin_s, blocks_before = time.monotonic(), received.blocks
    received.lags_s.clear()
    received.worst_s = 0.0
    await asyncio.sleep(60.0 * arguments.minutes)
    elapsed_s, processed_blocks = time.monotonic() - measure_begin_s, received.blocks - blocks_before
    cpu_time_s = {name: cpu_s(pid) - cpu_before_s[name] for name, pid in pids.items()}
    idle_s = psutil.cpu_times().idle - idle_before_s
    memory_mib = {name: rss_mib(pid) for name, pid in pids.items()}
    wire_bytes = _wire_bytes(fleet_rig)
    lags_s = np.sort(received.lags_s) if received.lags_s else np.array([np.nan])
    worst_s = received.worst_s
    await asyncio.to_thread(edges.wait, LONG_S + 120.0 * minutes)
    stop_begin_s = time.monotonic()
    await asyncio.to_thread(fleet_rig.stop_workers)
    stop_time_s = time.monotonic() - stop_begin_s
    raw_bytes, raw_messages, states_bytes = await _stream_sizes(fleet_rig)
    pack_days = max(1, processed_blocks) * BLOCK_S / DAY_S  # days of samples in the processed blocks
    workers_cpu_s = sum(cpu_time_s[name] for name in names)
    blocks_per_day = DAY_S / BLOCK_S
    sys.stderr.write((fleet_rig.folder / "edges.log").read_text().splitlines()[-1] + "\n")
    return {
        "blocks/s": f"{processed_blocks / elapsed_s:,.1f}",
        "samples/s": f"{processed_blocks * BLOCK_S / elapsed_s:,.0f}",
        "lag p50, s": f"{np.quantile(lags_s, 0.5):.2f}",
        "lag p99, s": f"{np.quantile(lags_s, 0.99):.2f}",
        "lag max of those received, s": f"{lags_s[-1]:.2f} of {lags_s.size:,}",
        "lag max of all, s": f"{worst_s:.2f}",
        "workers, CPU, cores": f"{workers_cpu_s / elapsed_s:.3f}",
        "server, CPU, cores": f"{cpu_time_s['server'] / elapsed_s:.3f}",
        "edges simulated, CPU, cores": f"{cpu_time_s['edges'] / elapsed_s:.3f}",
        "fits, CPU, cores": f"{sum(cpu_time_s[name] for name in fits) / elapsed_s:.3f}",
        "fits, late fits": f"{received.total('fits')}, {received.total('late_fits')}",
        "spare cores": f"{idle_s / elapsed_s:.2f}",
        "workers, CPU per block, ms": f"{1e3 * workers_cpu_s / max(1, processed_blocks):.3f}",
        "server, CPU per block, ms": f"{1e3 * cpu_time_s['server'] / max(1, processed_blocks):.3f}",
        "workers, CPU per pack-day, s": f"{workers_cpu_s / pack_days:.3f}",
        "server, CPU per pack-day, s": f"{cpu_time_s['server'] / pack_days:.3f}",
        "wire per pack-day, kB": f"{wire_bytes / raw_messages * blocks_per_day / 1e3:,.0f}",
        "stream per pack-day, kB": f"{raw_bytes / raw_messages * blocks_per_day / 1e3:,.0f}",
        "checkpoint per pack, kB": f"{states_bytes / packs / 1e3:.1f}",
        "workers, memory each, MiB": f"{max(memory_mib[name] for name in names):,.0f}",
        "server, memory, MiB": f"{memory_mib['server']:,.0f}",
        "table loaded in, s": f"{load_time_s:.1f}",
        "clean stop, with checkpoints, s": f"{stop_time_s:.1f}",
        "resends, gaps, lost blocks": " ".join(
            str(received.total(counter)) for counter in ("resends", "gaps", "lost_blocks")
        ),
        "true SOC within 2 std": f"{received.within[True] / max(1, received.within.total()):.3f}",
    }


async def _listen(fleet_rig: Rig, fleet: SimulatedFleet) -> ReceivedMessages:
    """Receive heartbeats and the estimates of some packs."""
    received = ReceivedMessages()
    nc = await fleet_rig.connected()
    index = {name: i for i, name in enumerate(fleet.names)}

    async def record_heartbeat(message: Msg) -> None:
        heartbeat = Heartbeat.model_validate_json(message.data)
        received.workers[heartbeat.id] = heartbeat
        received.worst_s = max(received.worst_s, heartbeat.lag_s or 0.0)

    async def record_state(message: Msg) -> None:
        estimate: dict[str, Any] = json.loads(message.data)
        received.lags_s.append(time.time() - datetime.fromisoformat(estimate["time"]).timestamp())
        pack = np.array([index[message.subject.split(".")[1]]])
        truth = fleet.soc(pack, np.array([estimate["board_time_s"]]))[0]
        received.within[bool(abs(truth - estimate["soc"]) <= 2.0 * estimate["soc_std"])] += 1

    await nc.subscribe(subjects.worker(), cb=record_heartbeat)
    for name in fleet.names[:: max(1, len(fleet.names) // OBSERVED_PACKS)]:
        await nc.subscribe(subjects.published(name, "state"), cb=record_state)
    await nc.flush()
    return received


def _wire_bytes(fleet_rig: Rig) -> int:
    """Return the bytes that the server has received from the edges."""
    connections = fleet_rig.engine.ask(0, "connz?limit=1000")["connections"]
    return sum(
        connection["in_bytes"]
        for connection in connections
        if connection.get("mqtt_client", "").startswith("simulated")
    )


async def _stream_sizes(fleet_rig: Rig) -> tuple[int, int, int]:
    """Return bytes and messages of the stream of blocks, and bytes of the stream of checkpoints."""
    nc = await fleet_rig.connected()
    js = nc.jetstream()
    raw = (await js.stream_info(subjects.RAW_STREAM)).state
    states = (await js.stream_info(f"OBJ_{subjects.STATES_BUCKET}")).state
    await nc.close()
    return raw.bytes, raw.messages, states.bytes


if __name__ == "__main__":
    main()
