"""The demo of a fleet: server, simulated edges, two workers and the page as processes; one worker is killed.

It reports what it receives: heartbeats of the workers, and estimates of some packs beside their true SOC.
"""

import asyncio
import contextlib
import itertools
import json
import math
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
SPEED = 10.0
"""The packs' seconds per second: their minute is over in 6 s."""
SEED = 7
LISTENED = 100
"""Number of packs whose estimates are compared with the truth."""
SAID_S = 5.0
"""Interval between two progress lines [s]."""
KILL_AFTER = 0.4
"""Part of the time after which a worker is killed."""
PATIENCE_S = 120.0
"""Timeout of events that should take seconds: a server, a worker, the last blocks [s]."""
_WORKERS = ("ada", "bob")
_KILLED = _WORKERS[0]
_PORTS = range(20_000, 32_768)
"""Ports below the range that the kernel gives to outgoing connections, which could occupy one before a server
listens."""
_numbers = itertools.count(random.randrange(len(_PORTS)))

Say = Callable[[str], object]


@dataclass
class DemoObserver:
    """Observer of a demo.

    Attributes:
        partitions: Partitions with packs.
        workers: Last heartbeat by name, with its moment of a monotonic clock [s].
        errors: Estimated less true SOC, of estimates since the last line.
        within: Whether the true SOC was within two standard deviations.
        dead: Workers that were killed on purpose.
        worst_s: Longest lag since the last line [s].
    """

    partitions: set[int]
    workers: dict[str, tuple[float, Heartbeat]] = field(default_factory=dict)
    errors: list[float] = field(default_factory=list)
    within: Counter[bool] = field(default_factory=Counter)
    dead: set[str] = field(default_factory=set)
    worst_s: float = 0.0

    @property
    def alive(self) -> dict[str, Heartbeat]:
        """Workers with a heartbeat within ``DEAD_S`` that were not killed since."""
        now_s = time.monotonic()
        return {
            name: beat
            for name, (heard_s, beat) in self.workers.items()
            if now_s - heard_s < DEAD_S and name not in self.dead
        }

    @property
    def held(self) -> set[int]:
        """Partitions of workers that are alive."""
        return {number for beat in self.alive.values() for number in beat.partitions}

    @property
    def done(self) -> int:
        """Blocks that all workers have stepped, what one did again that another had lost among them."""
        return sum(beat.blocks for _, beat in self.workers.values())

    @property
    def taken(self) -> int:
        """Blocks, as the partitions' own counts have it: each once, whoever took it."""
        return sum(beat.counters.get("blocks", 0) for beat in self.alive.values())


@dataclass(frozen=True)
class Demo:
    """Parameters of a demo.

    Attributes:
        packs: Number of packs.
        seconds: Duration for which edges send.
        page_port: Port of the page.
        folder: For the server's files and all logs.
        say: Receives the progress, line by line.
        opened: Called with the page's address.
    """

    packs: int
    seconds: float
    page_port: int
    folder: Path
    say: Say
    opened: Callable[[str], object]


async def run_demo(demo: Demo, stop: asyncio.Event) -> None:
    """Run it until its end, or ``stop``.

    Raises:
        UserError: A process of it ends, or is not there in time.
    """
    nats_port, mqtt_port, monitor_port = (free_port() for _ in range(3))
    server, mqtt = f"nats://{LOOPBACK}:{nats_port}", f"mqtt://{LOOPBACK}:{mqtt_port}"
    config = demo.folder / "fleet.toml"
    config.write_text(
        f'[server]\nfolder = "{demo.folder}/server"\nlisten = "{LOOPBACK}:{nats_port}"\n'
        f'mqtt = "{LOOPBACK}:{mqtt_port}"\nmonitor = "{LOOPBACK}:{monitor_port}"\n'
    )
    begin_s = int(time.time()) - BLOCK_S
    fleet = SimulatedFleet(demo.packs, seed=SEED, begin_ns=begin_s * 10**9)
    table = demo.folder / "packs.csv"
    table.write_text(fleet.table())
    async with contextlib.AsyncExitStack() as stack:
        processes = Processes(demo.folder)
        stack.push_async_callback(processes.end)
        await processes.start("server", "serve", config)
        nc = await stack.enter_async_context(_connected(server, processes, stop))
        demo.say(f"server: {server} for workers and the page, {mqtt} for edges")
        await processes.run("packs", "packs", "load", table, "--server", server)
        demo.say(
            f"table: {demo.packs:,} packs of four kinds of cells; how much each has aged, and its SOC, nobody is told"
        )
        seen = await _listen(nc, fleet)
        for name in _WORKERS:
            await processes.start(name, "worker", "--server", server, "--name", name, "--checkpoint-s", 10)
        page = ("--listen", f"{LOOPBACK}:{demo.page_port}", "--no-browser")
        await processes.start("page", "page", "--server", server, *page)
        await processes.until(lambda: len(seen.alive) == len(_WORKERS), stop)
        demo.say(
            f"two workers: {' and '.join(_WORKERS)}, who share the packs by {subjects.PARTITIONS} partitions of them"
        )
        demo.say(f"the fleet's page: http://{LOOPBACK}:{demo.page_port}/")
        demo.opened(f"http://{LOOPBACK}:{demo.page_port}/")
        begin = datetime.fromtimestamp(begin_s, UTC).astimezone().replace(tzinfo=None).isoformat()
        edges = ("--packs", demo.packs, "--seed", SEED, "--speed", SPEED, "--begin", begin, "--mqtt", mqtt)
        await processes.start("edges", "simulate", *edges)
        demo.say(
            f"{demo.packs:,} edges, {SPEED:g} times as fast as real ones: each sends its block, a minute of samples, every "
            f"{BLOCK_S / SPEED:g} s"
        )
        await processes.until(lambda: seen.held >= seen.partitions, stop)  # workers hold those without a pack, too
        await _report_progress(demo, seen, processes, stop)
        if not stop.is_set():
            await processes.stop("edges")
            demo.say(await _counted(nc, seen, processes, stop))


async def _report_progress(demo: Demo, seen: DemoObserver, processes: "Processes", stop: asyncio.Event) -> None:
    """Report the progress, and kill a worker in the middle; the other one takes over with the packs' next blocks."""
    begin_s, kill_s, gone_s, spoke, done = time.monotonic(), KILL_AFTER * demo.seconds, math.inf, 1, 0
    while not stop.is_set():
        now_s = time.monotonic() - begin_s
        if kill_s == math.inf and now_s >= demo.seconds + (0.0 if gone_s == math.inf else PATIENCE_S):
            return
        processes.check()
        if now_s >= kill_s:
            held = len(seen.alive[_KILLED].partitions) if _KILLED in seen.alive else 0
            await processes.kill(_KILLED)
            seen.dead.add(_KILLED)
            demo.say(
                f"{now_s:4.0f} s  {_KILLED} is killed (SIGKILL), and with it all that it knew of its {held} partitions"
            )
            kill_s, gone_s = math.inf, now_s
        if gone_s < now_s and seen.held >= seen.partitions:
            demo.say(
                f"{now_s:4.0f} s  {_WORKERS[1]} has all partitions, {now_s - gone_s:.1f} s after the kill: it goes on from "
                f"{_KILLED}'s last checkpoints, and reads from the stream what came since"
            )
            gone_s = math.inf
        if now_s >= spoke * SAID_S:
            demo.say(f"{now_s:4.0f} s  {_line(seen, done)}")
            spoke, done = spoke + 1, seen.done
            seen.errors.clear()
            seen.worst_s = 0.0
        await asyncio.sleep(0.1)


def _line(seen: DemoObserver, done: int) -> str:
    rate = f"{(seen.done - done) / SAID_S:4,.0f} blocks/s estimated, {seen.worst_s:.1f} s after they came at most"
    error = f"; SOC {100.0 * float(np.mean(np.abs(seen.errors))):.1f} % off on average" if seen.errors else ""
    return f"{rate}{error}; {_who(seen)} partitions"


def _who(seen: DemoObserver) -> str:
    return " and ".join(f"{name} with {len(beat.partitions)}" for name, beat in sorted(seen.alive.items()))


async def _counted(nc: Client, seen: DemoObserver, processes: "Processes", stop: asyncio.Event) -> str:
    """Count the blocks that arrived and those that were processed."""
    kept = (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.messages

    def all_taken() -> bool:
        return seen.taken + sum(beat.counters.get("resends", 0) for beat in seen.alive.values()) >= kept

    await processes.until(all_taken, stop)
    within = seen.within[True] / max(1, seen.within.total())
    counted = Counter[str]()
    for beat in seen.alive.values():
        counted.update(beat.counters)
    return (
        f"end: {kept:,} blocks came into the stream; {seen.taken:,} were taken, each once, {counted['resends']:,} had come "
        f"before, {counted['lost_blocks']:,} lost; the true SOC was within two standard deviations in {100.0 * within:.0f} % "
        f"of {seen.within.total():,} estimates"
    )


async def _listen(nc: Client, fleet: SimulatedFleet) -> DemoObserver:
    """Receive all heartbeats, and the estimates of some packs."""
    seen = DemoObserver({subjects.partition_of(name, subjects.PARTITIONS) for name in fleet.names})
    index = {name: i for i, name in enumerate(fleet.names)}

    async def beat(message: Msg) -> None:
        heard = Heartbeat.model_validate_json(message.data)
        seen.workers[heard.id] = time.monotonic(), heard
        seen.worst_s = max(seen.worst_s, heard.lag_s or 0.0)

    async def state(message: Msg) -> None:
        estimate = json.loads(message.data)
        pack = np.array([index[message.subject.split(".")[1]]])
        error = estimate["soc"] - float(fleet.soc(pack, np.array([estimate["board_time_s"]]))[0])
        seen.errors.append(error)
        seen.within[abs(error) <= 2.0 * estimate["soc_std"]] += 1

    await nc.subscribe(subjects.worker(), cb=beat)
    for name in fleet.names[:: max(1, len(fleet.names) // LISTENED)]:
        await nc.subscribe(subjects.published(name, "state"), cb=state)
    await nc.flush()
    return seen


@contextlib.asynccontextmanager
async def _connected(server: str, processes: "Processes", stop: asyncio.Event) -> AsyncIterator[Client]:
    """Connect once the server has its streams."""
    log = processes.folder / "server.log"
    await processes.until(lambda: "streams ready" in log.read_text(), stop)
    nc = await nats.connect(server)
    try:
        yield nc
    finally:
        await nc.close()


class Processes:
    """Commands of ``fleet`` as processes; the output of each is in a file of ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: dict[str, asyncio.subprocess.Process] = {}

    async def start(self, name: str, *arguments: object) -> asyncio.subprocess.Process:
        """Start one in its own process group, so that Ctrl-C reaches this process only, which ends the others."""
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
        """Start one and wait for its end.

        Raises:
            UserError: It fails.
        """
        process = await self.start(name, *arguments)
        if await process.wait():
            raise self._ended(name)
        del self._running[name]

    async def until(self, true: Callable[[], bool], stop: asyncio.Event) -> None:
        """Wait for something, or for ``stop``.

        Raises:
            UserError: A process has ended, or it takes too long.
        """
        end_s = time.monotonic() + PATIENCE_S
        while not stop.is_set() and not true():
            self.check()
            if time.monotonic() > end_s:
                raise UserError(f"the demo has waited {PATIENCE_S:g} s in vain; {', '.join(self._running)} run")
            await asyncio.sleep(HEARTBEAT_S / 10.0)

    def check(self) -> None:
        """Check that all processes run.

        Raises:
            UserError: One has ended.
        """
        for name, process in self._running.items():
            if process.returncode is not None:
                raise self._ended(name)

    async def kill(self, name: str) -> None:
        """Kill by SIGKILL."""
        process = self._running.pop(name)
        process.kill()
        await process.wait()

    async def stop(self, name: str) -> None:
        """Stop by SIGTERM, then by SIGKILL."""
        process = self._running.pop(name)
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), PATIENCE_S)
        except TimeoutError:
            process.kill()
            await process.wait()

    async def end(self) -> None:
        """All, the server last."""
        for name in reversed(list(self._running)):
            await self.stop(name)

    def _ended(self, name: str) -> UserError:
        said = (self.folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return UserError(f"{name} has ended: {said[-1] if said else 'it said nothing'}")


def free_port() -> int:
    """Return a free loopback port; never the same one twice in a row.

    Raises:
        UserError: It does not exist.
    """
    for number in itertools.islice(_numbers, len(_PORTS)):
        port = _PORTS[number % len(_PORTS)]
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((LOOPBACK, port))
            return port
    raise UserError("no port is free")
