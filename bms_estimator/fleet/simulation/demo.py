"""Demo of a fleet: server, simulated edges, two workers and the page as processes. One worker is killed.

The demo reports the workers' heartbeats, and compares the estimates of some packs with their true SOC.
"""

import asyncio
import contextlib
import itertools
import json
import random
import socket
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import nats
import numpy as np
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import DEAD_S, HEARTBEAT_S, Heartbeat
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.model.errors import UserError
from bms_estimator.process.child_process import ends_with_us

LOOPBACK = "127.0.0.1"
"""Address on which all processes listen."""
SPEED = 10.0
"""Simulated seconds per second: an edge sends a block of a simulated minute every 6 s."""
SEED = 7
"""Seed of the simulated packs."""
OUTAGE_DAYS = 1
"""Outage for which the streams have space [days], much longer than the demo, so that a small disk suffices."""
OBSERVED_PACKS = 100
"""Number of packs whose estimates are compared with the true SOC."""
PROGRESS_S = 5.0
"""Interval between two progress lines [s]."""
KILL_AFTER = 0.4
"""Fraction of the duration after which a worker is killed."""
TIMEOUT_S = 120.0
"""Timeout of a start, a takeover and the last blocks [s], which normally take seconds."""
_WORKERS = ("ada", "bob")
_KILLED = _WORKERS[0]
_PORTS = range(20_000, 32_768)
"""Range of ports for the servers. It lies below the ports of outgoing connections, which could occupy a port before a
server listens on it."""
_port_offsets = itertools.count(random.randrange(len(_PORTS)))


@dataclass
class DemoObserver:
    """Heartbeats and estimates received during a demo.

    Attributes:
        partitions: Numbers of the partitions that contain packs.
        workers: Last heartbeat of each worker and the monotonic clock of its arrival [s].
        errors: Estimated minus true SOC since the last progress line.
        within: Number of estimates whose true SOC is within two standard deviations (True), or is not (False).
        dead: Names of the killed workers.
        max_lag_s: Largest lag since the last progress line [s].
    """

    partitions: set[int]
    workers: dict[str, tuple[float, Heartbeat]] = field(default_factory=dict)
    errors: list[float] = field(default_factory=list)
    within: Counter[bool] = field(default_factory=Counter)
    dead: set[str] = field(default_factory=set)
    max_lag_s: float = 0.0

    @property
    def alive(self) -> dict[str, Heartbeat]:
        """Last heartbeats of the workers that are alive."""
        now_s = time.monotonic()
        return {
            name: heartbeat
            for name, (received_s, heartbeat) in self.workers.items()
            if now_s - received_s < DEAD_S and name not in self.dead
        }

    @property
    def owned_partitions(self) -> set[int]:
        """Partitions that live workers own."""
        return {number for heartbeat in self.alive.values() for number in heartbeat.partitions}

    @property
    def processed(self) -> int:
        """Number of blocks that all workers have processed, including those that were processed again after the kill."""
        return sum(heartbeat.blocks for _, heartbeat in self.workers.values())

    @property
    def counted_blocks(self) -> int:
        """Number of blocks according to the counters of the partitions, which count each block once."""
        return sum(heartbeat.counters.get("blocks", 0) for heartbeat in self.alive.values())


@dataclass(frozen=True)
class Demo:
    """Parameters of a demo.

    Attributes:
        packs: Number of packs.
        seconds: Duration for which edges send.
        page_port: Port of the page.
        folder: Folder of the server's files and of all logs.
        report: Receives progress lines.
        on_page: Called with the page's address.
    """

    packs: int
    seconds: float
    page_port: int
    folder: Path
    report: Callable[[str], object]
    on_page: Callable[[str], object]


async def run_demo(demo: Demo, stop: asyncio.Event) -> None:
    """Run the demo until its end or until ``stop`` is set.

    Raises:
        UserError: A process has ended or did not start in time.
    """
    nats_port, mqtt_port, monitor_port = (free_port() for _ in range(3))
    server, mqtt = f"nats://{LOOPBACK}:{nats_port}", f"mqtt://{LOOPBACK}:{mqtt_port}"
    config = demo.folder / "fleet.toml"
    config.write_text(
        f'[server]\nfolder = "{demo.folder}/server"\nlisten = "{LOOPBACK}:{nats_port}"\n'
        f'mqtt = "{LOOPBACK}:{mqtt_port}"\nmonitor = "{LOOPBACK}:{monitor_port}"\n'
        f"packs = {demo.packs}\noutage_days = {OUTAGE_DAYS}\n"
    )
    # the edges are faster than real time, and their clocks must not get ahead of the server's
    begin_s = int(time.time() - SPEED * (demo.seconds + TIMEOUT_S)) - BLOCK_S
    fleet = SimulatedFleet(demo.packs, seed=SEED, begin_ns=begin_s * 10**9)
    table = demo.folder / "packs.csv"
    table.write_text(fleet.table())
    async with contextlib.AsyncExitStack() as stack:
        processes = Processes(demo.folder)
        stack.push_async_callback(processes.end)
        await processes.start("server", "serve", config)
        nc = await stack.enter_async_context(_connected(server, processes, stop))
        demo.report(f"server: {server} for workers and the page, {mqtt} for edges")
        await processes.run("packs", "packs", "load", table, "--server", server)
        demo.report(
            f"table: {demo.packs:,} packs of four kinds of cells; ageing and SOC of each are hidden from the workers"
        )
        observer = await _observe(nc, fleet)
        for name in _WORKERS:
            await processes.start(name, "worker", "--server", server, "--name", name, "--checkpoint-s", 10)
        page = ("--listen", f"{LOOPBACK}:{demo.page_port}", "--no-browser")
        await processes.start("page", "page", "--server", server, *page)
        await processes.until(lambda: len(observer.alive) == len(_WORKERS), stop)
        demo.report(f"two workers: {' and '.join(_WORKERS)}, which share {subjects.PARTITIONS} partitions of the packs")
        demo.report(f"the fleet's page: http://{LOOPBACK}:{demo.page_port}/")
        demo.on_page(f"http://{LOOPBACK}:{demo.page_port}/")
        begin = datetime.fromtimestamp(begin_s, UTC).astimezone().replace(tzinfo=None).isoformat()
        edges = ("--packs", demo.packs, "--seed", SEED, "--speed", SPEED, "--begin", begin, "--mqtt", mqtt)
        await processes.start("edges", "simulate", *edges)
        demo.report(
            f"{demo.packs:,} edges, {SPEED:g} times as fast as real ones: each sends a block, a minute of samples, every "
            f"{BLOCK_S / SPEED:g} s"
        )
        # a superset of the partitions with packs, because workers also claim partitions without packs
        await processes.until(lambda: observer.owned_partitions >= observer.partitions, stop)
        await _report_progress(demo, observer, processes, stop)
        if not stop.is_set():
            await processes.stop("edges")
            demo.report(await _totals(nc, observer, processes, stop))


async def _report_progress(demo: Demo, observer: DemoObserver, processes: "Processes", stop: asyncio.Event) -> None:
    """Report the progress, kill a worker after ``KILL_AFTER``, and report when the other worker has taken over."""
    begin_s, line_count, processed = time.monotonic(), 1, 0
    killed_s: float | None = None
    is_taken_over = False
    while not stop.is_set():
        now_s = time.monotonic() - begin_s
        if killed_s is not None and now_s >= demo.seconds + (0.0 if is_taken_over else TIMEOUT_S):
            return
        processes.check()
        if killed_s is None and now_s >= KILL_AFTER * demo.seconds:
            owned_count = len(observer.alive[_KILLED].partitions) if _KILLED in observer.alive else 0
            await processes.kill(_KILLED)
            observer.dead.add(_KILLED)
            demo.report(
                f"{now_s:4.0f} s  {_KILLED} is killed (SIGKILL), and its states of {owned_count} partitions are lost"
            )
            killed_s = now_s
        elif killed_s is not None and not is_taken_over and observer.owned_partitions >= observer.partitions:
            demo.report(
                f"{now_s:4.0f} s  {_WORKERS[1]} has all partitions, {now_s - killed_s:.1f} s after the kill: it continues from "
                f"{_KILLED}'s last checkpoints and reads the later blocks from the stream"
            )
            is_taken_over = True
        if now_s >= line_count * PROGRESS_S:
            demo.report(f"{now_s:4.0f} s  {_progress_line(observer, processed)}")
            line_count, processed = line_count + 1, observer.processed
            observer.errors.clear()
            observer.max_lag_s = 0.0
        await asyncio.sleep(0.1)


def _progress_line(observer: DemoObserver, processed_before: int) -> str:
    rate = f"{(observer.processed - processed_before) / PROGRESS_S:4,.0f} blocks/s estimated, at most {observer.max_lag_s:.1f} s after their arrival"
    error = f"; mean SOC error {100.0 * float(np.mean(np.abs(observer.errors))):.1f} %" if observer.errors else ""
    return f"{rate}{error}; {_partition_counts(observer)} partitions"


def _partition_counts(observer: DemoObserver) -> str:
    return " and ".join(
        f"{name} with {len(heartbeat.partitions)}" for name, heartbeat in sorted(observer.alive.items())
    )


async def _totals(nc: Client, observer: DemoObserver, processes: "Processes", stop: asyncio.Event) -> str:
    """Wait until all blocks are processed, and return the totals as text."""
    stored = (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.messages

    def all_processed() -> bool:
        return (
            observer.counted_blocks + sum(heartbeat.counters.get("resends", 0) for heartbeat in observer.alive.values())
            >= stored
        )

    await processes.until(all_processed, stop)
    within = observer.within[True] / max(1, observer.within.total())
    counters = Counter[str]()
    for heartbeat in observer.alive.values():
        counters.update(heartbeat.counters)
    return (
        f"end: {stored:,} blocks are in the stream; {observer.counted_blocks:,} were processed once, {counters['resends']:,} were repetitions"
        f", {counters['lost_blocks']:,} lost; the true SOC was within two standard deviations in {100.0 * within:.0f} % "
        f"of {observer.within.total():,} estimates"
    )


async def _observe(nc: Client, fleet: SimulatedFleet) -> DemoObserver:
    """Subscribe to all heartbeats and to the estimates of some packs."""
    observer = DemoObserver({subjects.partition_of(name, subjects.PARTITIONS) for name in fleet.names})
    index = {name: i for i, name in enumerate(fleet.names)}

    async def on_heartbeat(message: Msg) -> None:
        heartbeat = Heartbeat.model_validate_json(message.data)
        observer.workers[heartbeat.id] = time.monotonic(), heartbeat
        observer.max_lag_s = max(observer.max_lag_s, heartbeat.lag_s or 0.0)

    async def on_state(message: Msg) -> None:
        estimate = json.loads(message.data)
        pack = np.array([index[message.subject.split(".")[1]]])
        error = estimate["soc"] - float(fleet.soc(pack, np.array([estimate["board_time_s"]]))[0])
        observer.errors.append(error)
        observer.within[abs(error) <= 2.0 * estimate["soc_std"]] += 1

    await nc.subscribe(subjects.worker(), cb=on_heartbeat)
    for name in fleet.names[:: max(1, len(fleet.names) // OBSERVED_PACKS)]:
        await nc.subscribe(subjects.published(name, "state"), cb=on_state)
    await nc.flush()
    return observer


@contextlib.asynccontextmanager
async def _connected(server: str, processes: "Processes", stop: asyncio.Event) -> AsyncIterator[Client]:
    """Connect once the server has created its streams."""
    log = processes.folder / "server.log"
    await processes.until(lambda: "streams ready" in log.read_text(), stop)
    nc = await nats.connect(server)
    try:
        yield nc
    finally:
        await nc.close()


class Processes:
    """Processes of ``fleet`` commands; each writes its output to a file in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: dict[str, asyncio.subprocess.Process] = {}

    async def start(self, name: str, *arguments: object) -> asyncio.subprocess.Process:
        """Start a command in a new session, so that Ctrl-C reaches only this process, which ends the others."""
        command = (sys.executable, "-c", "from bms_estimator.cli.main import main; main()", "fleet")
        with (self.folder / f"{name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *command,
                *map(str, arguments),
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=ends_with_us(),
            )
        self._running[name] = process
        return process

    async def run(self, name: str, *arguments: object) -> None:
        """Run a command to its end.

        Raises:
            UserError: The command fails.
        """
        process = await self.start(name, *arguments)
        if await process.wait():
            raise self._ended(name)
        del self._running[name]

    async def until(self, condition: Callable[[], bool], stop: asyncio.Event) -> None:
        """Wait for a condition, or for ``stop``.

        Raises:
            UserError: A process has ended, or the wait has timed out.
        """
        end_s = time.monotonic() + TIMEOUT_S
        while not stop.is_set() and not condition():
            self.check()
            if time.monotonic() > end_s:
                raise UserError(f"the demo timed out after {TIMEOUT_S:g} s; running: {', '.join(self._running)}")
            await asyncio.sleep(HEARTBEAT_S / 10.0)

    def check(self) -> None:
        """Check that all processes run.

        Raises:
            UserError: A process has ended.
        """
        for name, process in self._running.items():
            if process.returncode is not None:
                raise self._ended(name)

    async def kill(self, name: str) -> None:
        """Kill a process by SIGKILL."""
        process = self._running.pop(name)
        process.kill()
        await process.wait()

    async def stop(self, name: str) -> None:
        """Stop a process by SIGTERM; after a timeout by SIGKILL."""
        process = self._running.pop(name)
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), TIMEOUT_S)
        except TimeoutError:
            process.kill()
            await process.wait()

    async def end(self) -> None:
        """Stop all processes, the server last."""
        for name in reversed(list(self._running)):
            await self.stop(name)

    def _ended(self, name: str) -> UserError:
        lines = (self.folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return UserError(f"{name} has ended: {lines[-1] if lines else 'without output'}")


def free_port() -> int:
    """Return a free loopback port, another one at each call.

    Raises:
        UserError: No port is free.
    """
    for number in itertools.islice(_port_offsets, len(_PORTS)):
        port = _PORTS[number % len(_PORTS)]
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((LOOPBACK, port))
            return port
    raise UserError("no port is free")
