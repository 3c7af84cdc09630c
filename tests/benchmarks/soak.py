"""Kills at random of all that the service lives with: itself, the broker, the line. ``make soak ARGS="1000 3600"``.

Real processes on loopback: service, Mosquitto, and a board on a pseudo-terminal with a simulated pack at its sensors,
whose SOC is known. What is judged afterwards stands in soak_account.py.
"""

import asyncio
import contextlib
import json
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import aiomqtt
import psutil

from bms_estimator.model.cell import load_cell
from bms_estimator.protocols.firmware.messages import ResetCause
from bms_estimator.simulation.simulated_pack import SimulatedPack, random_steps
from bms_estimator.simulation.virtual_adc import BoardParts, Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from tests.benchmarks.soak_account import Account, State, judged
from tests.benchmarks.table import show
from tests.command_line import PROGRAM
from tests.mosquitto import Broker
from tests.patience import LONG_S

CELL, SERIES, SOC, RATE_HZ, PUBLISH_RATE_HZ = "ncr18650", 4, 0.8, 50, 2
DIVIDER = 4.0
LOAD_C = 1.5
"""Steps of the load reach from a quarter of it, charging, to all of it."""
FINEST_S = 0.1
"""The load goes on so finely while nobody measures [s]."""
SERVICE_S, LINE_S, BROKER_S = 6.0, 7.0, 20.0
"""Means of the time from one kill to the next [s]."""
WHILE_IT_STARTS = 0.2
"""Part of the services that are not waited for before the time to their next kill begins."""
LONGEST_AWAY_S = 6.0
"""A broker or a board is away for up to so long [s]."""
KEPT_BROKER = (
    "allow_anonymous true\npersistence true\nautosave_interval 1\nautosave_on_changes true\npersistence_location "
)
"""Its sessions outlive it: what it has acknowledged is for the listener."""

PACK = """
[pack]
name = "soak"
cell = "{cell}"
series = {series}
initial_soc = {soc}
[identifier]
soc_std = 0.02
[sensor]
port = "{folder}/board"
sample_rate_hz = {rate_hz}
voltage_resolution_v = {resolution_v}
[publish]
rate_hz = {publish_rate_hz}
[mqtt]
url = "{url}"
[state]
folder = "{folder}/state"
"""


class Sensors:
    """The pack at the board's sensors: its time goes on while no board is there."""

    def __init__(self, account: Account) -> None:
        cell = load_cell(CELL).pack(SERIES, 1)
        self._pack = SimulatedPack(cell, random_steps(LOAD_C * cell.cell.capacity_ah, 1), soc=SOC)
        self._account, self._begin_s, self.offset_s = account, time.monotonic(), 0.0

    def plug(self, board_s: float) -> None:
        self.offset_s = time.monotonic() - self._begin_s - board_s

    def __call__(self, board_s: float) -> Reading:
        time_s = board_s + self.offset_s
        while time_s - self._pack.time_s > FINEST_S:
            self._pack(self._pack.time_s + FINEST_S)
        reading = self._pack(max(time_s, self._pack.time_s))
        self._account.truth.append((time.time(), self._pack.soc))
        return reading


@dataclass
class Soak:
    """One run.

    Attributes:
        kills: It ends after so many.
        until_s: Or at this moment of the monotonic clock [s].
        pace: How many times as often as usual something is killed.
    """

    folder: Path
    broker: Broker
    kills: int
    until_s: float
    dice: random.Random
    pace: float
    account: Account = field(default_factory=Account)
    killed: Counter[str] = field(default_factory=Counter)
    wanted: asyncio.Event = field(default_factory=asyncio.Event)
    """Set by each state that comes."""

    def __post_init__(self) -> None:
        self.sensors = Sensors(self.account)
        self.board = VirtualBoard(self.sensors, rate_hz=RATE_HZ, parts=BoardParts(divider=DIVIDER))
        self.log = self.folder / "log"
        self.pack = self.folder / "pack.toml"
        values = {
            "cell": CELL,
            "soc": SOC,
            "series": SERIES,
            "folder": self.folder,
            "url": self.broker.url,
            "rate_hz": RATE_HZ,
        }
        resolution_v = 5.0 * DIVIDER / 1024
        self.pack.write_text(PACK.format(**values, publish_rate_hz=PUBLISH_RATE_HZ, resolution_v=resolution_v))

    async def run(self) -> None:
        async with contextlib.AsyncExitStack() as stack:
            for task in (self._listen(), self._watch()):
                await stack.enter_async_context(background(task))
            self._plug()
            stack.push_async_callback(self._unplug)
            self.service = await self._start()
            stack.push_async_callback(self._end_service)
            await self._states_after(time.time())
            while not any((self.folder / "state").glob("*.npz")):  # noqa: ASYNC110 - nobody tells when a file is there
                await asyncio.sleep(0.05)
            faults = {"service": (SERVICE_S, self._kill_service), "line": (LINE_S, self._kill_line)}
            faults["broker"] = (BROKER_S, self._kill_broker)
            await asyncio.gather(*(self._again(name, *fault) for name, fault in faults.items()))
            await self._states_after(time.time())

    async def _again(self, name: str, mean_s: float, kill: Callable[[], Awaitable[None]]) -> None:
        """Kill and bring back, until there were enough in all."""
        while True:
            pause_s = self.dice.uniform(0.0, 2.0 * mean_s / self.pace)
            await asyncio.sleep(max(0.0, min(pause_s, self.until_s - time.monotonic())))
            if self.killed.total() >= self.kills or time.monotonic() >= self.until_s:
                return
            self.killed[name] += 1
            await kill()
            if name == "service" and self.dice.random() > WHILE_IT_STARTS:
                await self._states_after(time.time())

    async def _start(self) -> asyncio.subprocess.Process:
        with self.log.open("a") as log:
            return await asyncio.create_subprocess_exec(
                PROGRAM, "run", "--no-view", self.pack, stdout=asyncio.subprocess.DEVNULL, stderr=log
            )

    async def _kill_service(self) -> None:
        self.account.ended_alone += self.service.returncode is not None
        self.account.kills.append(time.time())
        await self._end_service()
        self.service = await self._start()

    async def _end_service(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.service.kill()
        await self.service.wait()

    def _plug(self) -> None:
        self.board.__enter__()
        (self.folder / "board").symlink_to(self.board.path)
        self.sensors.plug(self.board.time_s)
        self.board.reset(ResetCause.POWER_ON)
        self._sampling = asyncio.create_task(self.board.run())

    async def _unplug(self) -> None:
        self._sampling.cancel()
        await asyncio.gather(self._sampling, return_exceptions=True)
        (self.folder / "board").unlink()
        self.board.__exit__()

    async def _kill_line(self) -> None:
        self.account.unplugged.append(time.time())
        await self._unplug()
        await asyncio.sleep(self.dice.uniform(0.0, LONGEST_AWAY_S))
        self._plug()

    async def _kill_broker(self) -> None:
        """Killed, ended or frozen, one as likely as the other."""
        process, how = self.broker._process, self.dice.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP))
        assert process
        begin_s = time.time()
        process.send_signal(how)
        if how != signal.SIGSTOP:
            await asyncio.to_thread(process.wait)
        await asyncio.sleep(self.dice.uniform(0.0, LONGEST_AWAY_S))
        if how == signal.SIGSTOP:
            process.send_signal(signal.SIGCONT)
        else:
            await asyncio.to_thread(self.broker.start)
        self.account.silent.append((begin_s, time.time()))

    async def _listen(self) -> None:
        """Take the states, whatever becomes of the broker: it keeps what is for a client that comes back."""
        while True:
            with contextlib.suppress(aiomqtt.MqttError):
                address = {"hostname": "127.0.0.1", "port": self.broker.port}
                async with aiomqtt.Client(**address, identifier="soak", clean_session=False, timeout=2.0) as client:  # type: ignore[arg-type]
                    await client.subscribe("bms/soak/state", qos=1)
                    async for message in client.messages:
                        assert isinstance(message.payload, bytes)
                        self._take(json.loads(message.payload))
            await asyncio.sleep(0.1)

    def _take(self, state: dict[str, Any]) -> None:
        time_s = datetime.fromisoformat(state["time"]).timestamp()
        self.account.states.append(State(time_s, state["soc"], state["soc_std"]))
        self.wanted.set()

    async def _states_after(self, moment_s: float) -> None:
        try:
            async with asyncio.timeout(LONG_S):
                while not self.account.states or self.account.states[-1].time_s <= moment_s:
                    self.wanted.clear()
                    await self.wanted.wait()
        except TimeoutError:
            log = await asyncio.to_thread(self.log.read_text)
            raise AssertionError(f"no state came; the service said: {log[-3000:]}") from None

    async def _watch(self) -> None:
        """Memory of the service, and when this machine had no time for anybody."""
        before_s = time.time()
        while True:
            await asyncio.sleep(0.25)
            now_s = time.time()
            if now_s - before_s > 1.0:
                self.account.stalls.append((before_s, now_s))
            before_s = now_s
            with contextlib.suppress(psutil.Error, AttributeError):
                rss = psutil.Process(self.service.pid).memory_info().rss
                self.account.rss_bytes = max(self.account.rss_bytes, rss)


@contextlib.asynccontextmanager
async def background(work: Awaitable[None]) -> AsyncIterator[None]:
    """Do it beside; its fault is ours at the end."""
    task = asyncio.ensure_future(work)
    try:
        yield
    finally:
        if not task.cancel():
            task.result()
        await asyncio.gather(task, return_exceptions=True)


def soak(kills: int, seconds: float, seed: int, folder: Path, pace: float = 1.0) -> Soak:
    """Run, and bring together what there is to judge."""
    (folder / "state").mkdir()
    broker = Broker(folder, f"{KEPT_BROKER}{folder}/").start()
    try:

        async def run() -> Soak:
            one = Soak(folder, broker, kills, time.monotonic() + seconds, random.Random(seed), pace)
            await one.run()
            return one

        one = asyncio.run(run())
    finally:
        broker.stop()
    one.account.read_log(one.log.read_text())
    one.account.state_bytes = sum(path.stat().st_size for path in (folder / "state").iterdir())
    return one


def main() -> None:
    """Arguments: kills, at most so many seconds, seed."""
    given = [*map(int, sys.argv[1:]), *(1000, 3600, 1)[len(sys.argv) - 1 :]]
    kills, seconds, seed = given
    with tempfile.TemporaryDirectory() as folder:
        begin_s = time.monotonic()
        one = soak(kills, seconds, seed, Path(folder))
        what = ", ".join(f"{name} {count}" for name, count in sorted(one.killed.items()))
        seconds = round(time.monotonic() - begin_s)
    sys.exit(not show(judged(one.account), f"{one.killed.total()} kills in {seconds} s: {what}; seed {seed}"))


if __name__ == "__main__":
    main()
