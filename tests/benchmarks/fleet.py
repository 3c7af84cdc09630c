"""Cost of a fleet: server, workers and simulated edges as processes on loopback. ``make fleet ARGS="--packs 10000"``.

Lag is from the arrival of a block's last sample at the edge to the estimate made of it, here, as ``bms.<pack>.state``
arrives at a listener: of some packs for the shares, of all for the worst, which workers tell in their heartbeats.
The first minutes are not in the figures: every pack begins then.
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
from tests.benchmarks.fleet_rig import Rig, cpu_s, make, rig, rss_mib
from tests.patience import LONG_S

SEED, DAY_S, PARTITIONS = 1, 86_400.0, 64
OBSERVED_PACKS = 256
"""Number of packs whose estimates are received, evenly spread."""


@dataclass
class Heard:
    """Messages received in the measured time.

    Attributes:
        lags_s: Of estimates of the packs that are listened to [s].
        worst_s: Of all blocks, as workers say [s].
        within: Whether the true SOC was within two standard deviations, and how many were judged.
        workers: Last heartbeat by name.
    """

    lags_s: list[float] = field(default_factory=list)
    worst_s: float = 0.0
    within: Counter[bool] = field(default_factory=Counter)
    workers: dict[str, Heartbeat] = field(default_factory=dict)

    @property
    def blocks(self) -> int:
        """Number of blocks processed by all workers."""
        return sum(worker.blocks for worker in self.workers.values())

    def total(self, what: str) -> int:
        """Return the sum of a counter over all workers."""
        return sum(worker.counters.get(what, 0) for worker in self.workers.values())


def main() -> None:
    """Measure, print a table, and exit with 1 if a target was missed."""
    arguments = _arguments()
    load_kernels()  # compiled once, not by each worker
    rows = [asyncio.run(_measured(packs, arguments)) for packs in arguments.packs]
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
    parser.add_argument("--minutes", type=float, default=3.0, help="measured, after the first two")
    parser.add_argument("--warm-up", type=float, default=2.0, help="minutes before")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--speed", type=float, default=1.0, help="the packs' seconds per second")
    parser.add_argument("--json", type=Path, help="write the rows here, too")
    return parser.parse_args()


async def _measured(packs: int, arguments: argparse.Namespace) -> dict[str, str]:
    with tempfile.TemporaryDirectory() as folder, rig(Path(folder), 1, partitions=PARTITIONS) as fleet_rig:
        await make(fleet_rig, partitions=PARTITIONS)
        return await _run(fleet_rig, packs, arguments)


async def _run(fleet_rig: Rig, packs: int, arguments: argparse.Namespace) -> dict[str, str]:
    begin_s = int(time.time())
    fleet = SimulatedFleet(packs, seed=SEED, begin_ns=begin_s * 10**9)
    loaded_s = time.monotonic()
    await asyncio.to_thread(fleet_rig.load, fleet)
    loaded_s = time.monotonic() - loaded_s
    names = [fleet_rig.start_worker(checkpoint_s=CHECKPOINT_S) for _ in range(arguments.workers)]
    heard = await _listen(fleet_rig, fleet)
    await _until(lambda: len(heard.workers) == len(names))
    minutes = arguments.warm_up + arguments.minutes
    begin = datetime.fromtimestamp(begin_s, UTC).replace(tzinfo=None).isoformat()
    blocks = round(minutes * arguments.speed) + 1
    edges = fleet_rig.simulate(packs, seed=SEED, begin=f"{begin}", speed=arguments.speed, blocks=blocks)
    await asyncio.sleep(60.0 * arguments.warm_up)
    pids = {"server": fleet_rig.engine.pid(0), "edges": edges.pid} | {
        name: fleet_rig.workers[name].pid for name in names
    }
    used_s = {name: cpu_s(pid) for name, pid in pids.items()}
    begun_s, blocks_before = time.monotonic(), heard.blocks
    heard.lags_s.clear()
    heard.worst_s = 0.0
    await asyncio.sleep(60.0 * arguments.minutes)
    passed_s, taken = time.monotonic() - begun_s, heard.blocks - blocks_before
    used_s = {name: cpu_s(pid) - used_s[name] for name, pid in pids.items()}
    memory = {name: rss_mib(pid) for name, pid in pids.items()}
    wire = _wire_bytes(fleet_rig)
    lags = np.sort(heard.lags_s) if heard.lags_s else np.array([np.nan])
    worst_s = heard.worst_s
    await asyncio.to_thread(edges.wait, LONG_S + 120.0 * minutes)
    stopped_s = time.monotonic()
    await asyncio.to_thread(fleet_rig.stop_workers)
    stopped_s = time.monotonic() - stopped_s
    raw_bytes, raw_messages, states_bytes = await _stored(fleet_rig)
    pack_days = max(1, taken) * BLOCK_S / DAY_S  # of the processed blocks, even if some are missing
    work_s = sum(used_s[name] for name in names)
    a_day = DAY_S / BLOCK_S
    sys.stderr.write((fleet_rig.folder / "edges.log").read_text().splitlines()[-1] + "\n")
    return {
        "blocks/s": f"{taken / passed_s:,.1f}",
        "samples/s": f"{taken * BLOCK_S / passed_s:,.0f}",
        "lag p50, s": f"{np.quantile(lags, 0.5):.2f}",
        "lag p99, s": f"{np.quantile(lags, 0.99):.2f}",
        "lag max of those heard, s": f"{lags[-1]:.2f} of {lags.size:,}",
        "lag max of all, s": f"{worst_s:.2f}",
        "workers, CPU, cores": f"{work_s / passed_s:.3f}",
        "server, CPU, cores": f"{used_s['server'] / passed_s:.3f}",
        "edges simulated, CPU, cores": f"{used_s['edges'] / passed_s:.3f}",
        "workers, CPU per pack-day, s": f"{work_s / pack_days:.3f}",
        "server, CPU per pack-day, s": f"{used_s['server'] / pack_days:.3f}",
        "wire per pack-day, kB": f"{wire / raw_messages * a_day / 1e3:,.0f}",
        "stream per pack-day, kB": f"{raw_bytes / raw_messages * a_day / 1e3:,.0f}",
        "checkpoint per pack, kB": f"{states_bytes / packs / 1e3:.1f}",
        "workers, memory each, MiB": f"{max(memory[name] for name in names):,.0f}",
        "server, memory, MiB": f"{memory['server']:,.0f}",
        "table loaded in, s": f"{loaded_s:.1f}",
        "clean stop, with checkpoints, s": f"{stopped_s:.1f}",
        "resends, gaps, lost blocks": " ".join(str(heard.total(what)) for what in ("resend", "gap", "lost_blocks")),
        "true SOC within 2 std": f"{heard.within[True] / max(1, heard.within.total()):.3f}",
    }


async def _listen(fleet_rig: Rig, fleet: SimulatedFleet) -> Heard:
    """Receive heartbeats and the estimates of some packs."""
    heard = Heard()
    nc = await fleet_rig.connected()
    index = {name: i for i, name in enumerate(fleet.names)}

    async def beat(message: Msg) -> None:
        said = Heartbeat.model_validate_json(message.data)
        heard.workers[said.id] = said
        heard.worst_s = max(heard.worst_s, said.lag_s or 0.0)

    async def state(message: Msg) -> None:
        estimate: dict[str, Any] = json.loads(message.data)
        heard.lags_s.append(time.time() - datetime.fromisoformat(estimate["time"]).timestamp())
        pack = np.array([index[message.subject.split(".")[1]]])
        truth = fleet.soc(pack, np.array([estimate["board_time_s"]]))[0]
        heard.within[bool(abs(truth - estimate["soc"]) <= 2.0 * estimate["soc_std"])] += 1

    await nc.subscribe(subjects.worker(), cb=beat)
    for name in fleet.names[:: max(1, len(fleet.names) // OBSERVED_PACKS)]:
        await nc.subscribe(subjects.published(name, "state"), cb=state)
    await nc.flush()
    return heard


async def _until(true: Any) -> None:
    async with asyncio.timeout(LONG_S):
        while not true():  # noqa: ASYNC110 - messages arrive in callbacks
            await asyncio.sleep(0.1)


def _wire_bytes(fleet_rig: Rig) -> int:
    """Return the bytes that edges have sent, by the server's count."""
    found = fleet_rig.engine.ask(0, "connz?limit=1000")["connections"]
    return sum(each["in_bytes"] for each in found if each.get("mqtt_client", "").startswith("simulated"))


async def _stored(fleet_rig: Rig) -> tuple[int, int, int]:
    """Return bytes and messages of the stream of blocks, and bytes of that of checkpoints."""
    nc = await fleet_rig.connected()
    js = nc.jetstream()
    raw = (await js.stream_info(subjects.RAW_STREAM)).state
    states = (await js.stream_info(f"OBJ_{subjects.STATES_BUCKET}")).state
    await nc.close()
    return raw.bytes, raw.messages, states.bytes


if __name__ == "__main__":
    main()
