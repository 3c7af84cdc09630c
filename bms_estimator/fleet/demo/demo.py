"""Demo of a fleet: server, simulated edges, two workers, collector and page as processes.

The demo explains its steps: packs send samples, the fleet names the faults of three packs, and a worker is killed. It ends with a
table of the measured results.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import nats
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.demo import faulty_packs
from bms_estimator.fleet.demo.observer import Observer
from bms_estimator.fleet.demo.processes import LOOPBACK, POLL_S, TIMEOUT_S, Processes, free_port
from bms_estimator.fleet.heartbeat import HEARTBEAT_S
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.process.runtime import until_first_ends

INTERVAL_S = 5.0
"""Interval between two rows [s]."""
HEADING = "    time   blocks/s      lag   partitions"


class Progress:
    """Table of the progress.

    Args:
        observer: Received heartbeats and estimates.
        report: Receives the lines.
    """

    def __init__(self, observer: Observer, report: Callable[[str], object]) -> None:
        self._observer, self._report = observer, report
        self._begin_s = time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Time since the edges began to send [s]."""
        return time.monotonic() - self._begin_s

    async def show(self, until_s: float, processes: Processes) -> None:
        """Report at least one row, and further ones until a time [s since the edges began to send].

        Raises:
            UserError: A process has ended.
        """
        self._report(HEADING)
        end_s = -1.0
        while end_s < until_s:
            begin_s, processed, lags = self.elapsed_s, self._observer.processed, len(self._observer.lags_s)
            end_s = min(begin_s + INTERVAL_S, max(until_s, begin_s + HEARTBEAT_S))  # each row needs a heartbeat
            while self.elapsed_s < end_s:
                processes.check()
                await asyncio.sleep(POLL_S)
            rate = (self._observer.processed - processed) / (self.elapsed_s - begin_s)
            lag_s = max(self._observer.lags_s[lags:], default=0.0)
            owners = ", ".join(f"{name} {len(each.partitions)}" for name, each in sorted(self._observer.alive.items()))
            self._report(f"{self.elapsed_s:6.0f} s {rate:10,.0f} {lag_s:6.1f} s   {owners}")


async def stored_blocks(nc: Client) -> int:
    """Return the number of blocks in the stream ``RAW``."""
    return (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.messages


async def result_lines(nc: Client, observer: Observer, takeover_s: float, lags_before_kill: int) -> list[str]:
    """Return the lines of the table of results.

    Args:
        nc: Connection to the server.
        observer: Received heartbeats and estimates.
        takeover_s: Time from the kill to the takeover of the last partition [s].
        lags_before_kill: Number of ``observer.lags_s`` before the kill.
    """
    counters = observer.counters
    entries = await read_bucket(nc, subjects.CHECKPOINTS_BUCKET)
    pointers = [CheckpointPointer.model_validate_json(data) for data in entries.values()]
    before_s, after_s = (
        max(lags, default=0.0) for lags in (observer.lags_s[:lags_before_kill], observer.lags_s[lags_before_kill:])
    )
    rows = (
        ("blocks stored by the server", f"{await stored_blocks(nc):,}"),
        ("blocks estimated, each counted once", f"{counters['blocks']:,}"),
        ("blocks that edges sent again", f"{counters['resends']:,}"),
        ("undecodable blocks (dead letters)", f"{counters['damaged']:,}"),
        ("lost blocks", f"{counters['lost_blocks']:,}"),
        ("takeover after the kill", f"{takeover_s:.1f} s"),
        ("largest lag before the kill", f"{before_s:.1f} s"),
        ("largest lag after the kill", f"{after_s:.1f} s"),
        ("SOC estimates within 2 std of the truth", f"{100.0 * observer.within / max(1, observer.compared):.0f} %"),
        ("checkpoints: the last two of each partition", f"{sum(len(each.kept) for each in pointers):,}"),
        ("checkpoints: daily, stored for 30 days", f"{sum(len(each.daily) for each in pointers):,}"),
    )
    return [f"   {name:45}{value:>10}" for name, value in rows]


SPEED = 10.0
"""Simulated seconds per second: an edge sends a block of a simulated minute every 6 s."""
SEED = 7
"""Seed of the simulated packs."""
OUTAGE_DAYS = 1
"""Outage for which the streams have space [days]. It is much longer than the demo, but short enough for a small disk."""
CHECKPOINT_S = 10
"""Interval of checkpoints [s]."""
COLLECT_S = 1
"""Time after which the collector writes a summary to a file [s]."""
FAULTS_AFTER = 0.25
"""Fraction of the duration after which the packs with faults send their blocks."""
_WORKERS = ("ada", "bob")
_KILLED, _SURVIVOR = _WORKERS
_HOURS = "hours"
"""Folder of the Parquet files."""


@dataclass(frozen=True)
class Demo:
    """Parameters of a demo.

    Attributes:
        packs: Number of packs.
        seconds: Duration for which edges send.
        page_port: Port of the page.
        folder: Folder of the server's files and of all logs.
        report: Receives the explanations, line by line.
        on_page: Called with the page's address.
    """

    packs: int
    seconds: float
    page_port: int
    folder: Path
    report: Callable[[str], object]
    on_page: Callable[[str], object]


class _Addresses(NamedTuple):
    """Addresses of the servers."""

    nats: str
    mqtt: str
    page: str


class _Takeover(NamedTuple):
    """Takeover of the killed worker's partitions."""

    duration_s: float
    lags_before: int
    """Number of lags that were received before the kill."""


async def run_demo(demo: Demo, stop: asyncio.Event) -> None:
    """Run the demo until its end or until ``stop`` is set.

    Raises:
        UserError: A process has ended or did not start in time.
    """
    async with contextlib.AsyncExitStack() as stack:
        processes = Processes(demo.folder)
        stack.push_async_callback(processes.end)
        await until_first_ends(_run_steps(demo, processes, stack), stop.wait())


async def _run_steps(demo: Demo, processes: Processes, stack: contextlib.AsyncExitStack) -> None:
    """Run the steps of the demo."""
    # in the past, because the edges are faster than real time, and must not get ahead of the server's clock, even if two steps
    # take until their timeouts
    begin_s = int(time.time() - SPEED * (demo.seconds + 2.0 * TIMEOUT_S)) - BLOCK_S
    fleet = SimulatedFleet(demo.packs, seed=SEED, begin_ns=begin_s * 10**9)
    demo.report(
        f"A fleet on this machine: a server, {demo.packs:,} packs, two workers and a page. Only the packs are\n"
        "simulated. The demo sends faulty data, kills a worker, and shows what the fleet does.\n"
        "\n1. The parts start\n"
    )
    nc, addresses = await _start_server(demo, processes)
    stack.push_async_callback(nc.close)
    observer = await _start_workers(demo, fleet, nc, processes, addresses)
    progress = await _start_edges(demo, begin_s, observer, processes, addresses)
    await progress.show(FAULTS_AFTER * demo.seconds, processes)
    await _send_faulty_blocks(demo, fleet, nc, observer, processes)
    takeover = await _kill_worker(demo, observer, progress, processes)
    await progress.show(demo.seconds, processes)
    await processes.stop("edges")
    stored = await stored_blocks(nc)
    await processes.until(lambda: observer.read_blocks >= stored)
    demo.report("\n5. Measured\n")
    for line in await result_lines(nc, observer, *takeover):
        demo.report(line)
    demo.report(
        "\nNext\n"
        "   bms-estimator fleet demo --seconds 600   leaves time for the page\n"
        "   bms-estimator fleet demo --packs 10000   ten times as many packs\n"
        "   docs/fleet/index.md                      first steps with a fleet of your own"
    )


async def _start_server(demo: Demo, processes: Processes) -> tuple[Client, _Addresses]:
    """Start the server, and connect once it has created its streams."""
    nats_port, mqtt_port, monitor_port = (free_port() for _ in range(3))
    page = f"http://{LOOPBACK}:{demo.page_port}/"
    addresses = _Addresses(f"nats://{LOOPBACK}:{nats_port}", f"mqtt://{LOOPBACK}:{mqtt_port}", page)
    config = demo.folder / "fleet.toml"
    config.write_text(
        f'[server]\nfolder = "{demo.folder}/server"\nlisten = "{LOOPBACK}:{nats_port}"\n'
        f'mqtt = "{LOOPBACK}:{mqtt_port}"\nmonitor = "{LOOPBACK}:{monitor_port}"\n'
        f"packs = {demo.packs}\noutage_days = {OUTAGE_DAYS}\n"
    )
    await processes.start("server", "serve", config)
    log = demo.folder / "server.log"
    await processes.until(lambda: "streams ready" in log.read_text())
    demo.report(
        f"   server   stores all blocks on its disk: {addresses.nats} for the workers,\n"
        f"            {addresses.mqtt} for the edges, one beside each pack"
    )
    return await nats.connect(addresses.nats), addresses


async def _start_workers(
    demo: Demo, fleet: SimulatedFleet, nc: Client, processes: Processes, addresses: _Addresses
) -> Observer:
    """Load the table of packs, and start workers, collector and page."""
    table = demo.folder / "packs.csv"
    table.write_text(fleet.table() + faulty_packs.table())
    server = ("--server", addresses.nats)
    await processes.start("collector", "collect", *server, "--folder", demo.folder / _HOURS, "--period", COLLECT_S)
    listen = ("--listen", f"{LOOPBACK}:{demo.page_port}", "--no-browser")
    await processes.start("page", "page", *server, *listen)
    await processes.run("packs", "packs", "load", table, *server)
    names = (*fleet.names, *faulty_packs.NAMES)
    demo.report(
        f"   table    {len(names):,} packs with cell type and rated capacity. Their true capacity,\n"
        "            resistance and SOC are hidden from the workers."
    )
    observer = Observer({subjects.partition_of(name, subjects.PARTITIONS) for name in names})
    await observer.subscribe(nc, fleet)
    for name in _WORKERS:
        await processes.start(name, "worker", *server, "--name", name, "--checkpoint-s", CHECKPOINT_S)
    await processes.until(lambda: len(observer.alive) == len(_WORKERS))
    demo.report(
        f"   workers  {' and '.join(_WORKERS)} share the packs in {subjects.PARTITIONS} partitions\n"
        f"   page     {addresses.page}\n"
        f"   status   in a second terminal: bms-estimator fleet status --server {addresses.nats}"
    )
    demo.on_page(addresses.page)
    return observer


async def _start_edges(
    demo: Demo, begin_s: int, observer: Observer, processes: Processes, addresses: _Addresses
) -> Progress:
    """Start the edges, and wait until workers own all partitions."""
    begin = datetime.fromtimestamp(begin_s, UTC).astimezone().replace(tzinfo=None).isoformat()
    simulation = ("--packs", demo.packs, "--seed", SEED, "--speed", SPEED, "--begin", begin, "--mqtt", addresses.mqtt)
    await processes.start("edges", "simulate", *simulation)
    demo.report(
        "\n2. The packs send samples, and the workers estimate\n\n"
        f"   An edge sends a block, one minute of samples of its pack, every {BLOCK_S / SPEED:g} s. The packs run\n"
        f"   {SPEED:g} times as fast as real ones. The workers estimate SOC, capacity and resistances.\n"
        "   They do not know the SOC at the start, and learn it from the voltage.\n"
        "   The lag is the longest time from the last sample of a block to its estimate.\n"
    )
    await processes.until(lambda: observer.all_partitions_owned)
    return Progress(observer, demo.report)


async def _send_faulty_blocks(
    demo: Demo, fleet: SimulatedFleet, nc: Client, observer: Observer, processes: Processes
) -> None:
    """Send the blocks of the packs with faults, and report how the fleet names the faults."""
    demo.report(
        "\n3. Three more packs send data with faults\n\n"
        "   The fleet names each fault, and estimates all other packs as before.\n"
    )
    await faulty_packs.send_blocks(nc, fleet)
    letter = await processes.poll(lambda: faulty_packs.read_dead_letter(nc))
    demo.report(
        f"   {letter.pack}   sends a block that no worker can decode. The server stores it as a dead letter:\n"
        f"                {letter.reason}.\n"
        "                A real edge stores the block until upgraded workers have processed it."
    )
    clock = faulty_packs.WRONG_CLOCK
    await processes.until(lambda: observer.clock_error_s(clock) is not None)
    years = timedelta(seconds=observer.clock_error_s(clock) or 0.0).days / 365.25
    demo.report(
        f"   {clock}   has a clock in the year 2040. The workers report it {years:.1f} years ahead, and\n"
        "                quarantine its hourly summaries, which would distort queries on the fleet.\n"
        "                Its estimates continue."
    )
    weak = await processes.poll(lambda: faulty_packs.ask_weak_cell(processes, demo.folder / _HOURS))
    demo.report(
        f"   {weak['pack']}    sends the voltages of its 14 cells. `fleet ask failing` names cell {weak['cell']}:\n"
        f"                its SOC is {-100.0 * weak['value']:.0f} % below the mean of the cells."
    )


async def _kill_worker(demo: Demo, observer: Observer, progress: Progress, processes: Processes) -> _Takeover:
    """Kill a worker, and wait until the other one owns all partitions."""
    owned = len(observer.alive[_KILLED].partitions) if _KILLED in observer.alive else 0
    await processes.kill(_KILLED)
    killed_s, lags_before = progress.elapsed_s, len(observer.lags_s)
    observer.dead.add(_KILLED)
    demo.report(
        "\n4. A worker is killed\n\n"
        f"   At {killed_s:.0f} s {_KILLED} is killed (kill -9). The states of its {owned} partitions in memory are lost.\n"
        f"   {_SURVIVOR} continues from the checkpoints that {_KILLED} saved on the server every {CHECKPOINT_S} s, and reads\n"
        "   all later blocks from the stream. Therefore no block is lost, and the estimates are\n"
        "   those of an uninterrupted run."
    )
    await processes.until(lambda: observer.all_partitions_owned)
    duration_s = progress.elapsed_s - killed_s
    demo.report(
        f"   {_SURVIVOR} owns all partitions {duration_s:.1f} s after the kill. The lag is larger until it has caught up.\n"
    )
    return _Takeover(duration_s, lags_before)
