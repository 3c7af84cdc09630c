"""Process with a share of the simulated MQTT sessions."""

import asyncio
import multiprocessing as mp
import ssl
from collections.abc import Callable
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from bms_estimator.edge.block_sender import MAX_RECONNECT_DELAY_S
from bms_estimator.fleet.server import credentials
from bms_estimator.process.backoff import Backoff
from tests.benchmarks.fleet.mqtt_session import Delays, Options, Session, Totals
from tests.fleet.tenant import NAME

SOURCES = 8
"""Number of local IP addresses of the sessions of all processes."""
POLL_S = 0.05
"""Interval between two checks for commands, and between two reports [s]."""
COUNTS = ("ready", "connections", "blocks", "acknowledged", "sent", "requested", "timeout", "refused", "no answer")
"""Names of the reported totals."""


COMMANDS = {"drop": Session.drop, "finish": Session.finish}
"""Method of each session by command."""


class ConstantDelay:
    """Delay of one second without jitter."""

    def next_s(self) -> float:
        """Return the delay [s]."""
        return 1.0

    def reset(self) -> None:
        """Do nothing."""


DELAYS: dict[str, Callable[[], Delays]] = {
    "edge": lambda: Backoff(max_s=MAX_RECONNECT_DELAY_S),
    "short": Backoff,
    "constant": ConstantDelay,
}
"""Delays before reconnects, by the name of the option: of the edge, of the other MQTT clients, and constant."""


class Share(NamedTuple):
    """Sessions of one process."""

    packs: list[str]
    port: int
    ca: Path
    keys: Path
    persistent: bool
    block_s: float
    delays: str
    attempts: int
    """Maximum number of simultaneous connection attempts."""
    connect_s: float
    """Duration over which the first connections are spread [s]."""


class SessionProcess:
    """Running process with sessions.

    Args:
        share: Sessions of the process.
    """

    def __init__(self, share: Share) -> None:
        self._pipe, other = mp.Pipe()
        context = mp.get_context("spawn")
        self._counts: Any = context.Array("q", len(COUNTS), lock=False)
        self._process = context.Process(target=_run, args=(share, other, self._counts), daemon=True)
        self._process.start()

    @property
    def pid(self) -> int:
        """Process id."""
        assert self._process.pid
        return self._process.pid

    @property
    def counts(self) -> dict[str, int]:
        """Present totals by name."""
        return dict(zip(COUNTS, self._counts, strict=True))

    def wait_until_prepared(self) -> None:
        """Wait until the tokens are made and the modules are loaded."""
        assert self._pipe.recv() == "prepared"

    def command(self, text: str) -> None:
        """Send a command: ``start`` the sessions, ``drop`` their connections, or ``finish``: make no further blocks."""
        self._pipe.send(text)

    def latencies_s(self) -> list[float]:
        """Return the acknowledgment times since the last call [s]."""
        self._pipe.send("latencies")
        latencies: list[float] = self._pipe.recv()
        return latencies

    def stop(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.join()


def _run(share: Share, pipe: Connection, counts: Any) -> None:
    asyncio.run(_run_sessions(share, pipe, counts))


async def _run_sessions(share: Share, pipe: Connection, counts: Any) -> None:
    totals = Totals()
    tls = ssl.create_default_context(cafile=share.ca)
    attempts = asyncio.Semaphore(share.attempts)
    options = Options(share.port, tls, share.persistent, share.block_s, DELAYS[share.delays], attempts)
    sessions = [_make_session(i, pack, share, options, totals) for i, pack in enumerate(share.packs)]
    pipe.send("prepared")
    tasks = list[asyncio.Task[None]]()
    while True:
        while pipe.poll():
            command = pipe.recv()
            if command == "start":
                step_s = share.connect_s / len(sessions)
                tasks += [asyncio.create_task(session.run(i * step_s)) for i, session in enumerate(sessions)]
            elif command == "latencies":
                pipe.send(totals.acknowledge_s)
                totals.acknowledge_s = []
            else:
                for session in sessions:
                    COMMANDS[command](session)
        for i, name in enumerate(COUNTS):
            counts[i] = totals.counts[name]
        for task in tasks:
            if task.done():
                task.result()
        await asyncio.sleep(POLL_S)


def _make_session(i: int, pack: str, share: Share, options: Options, totals: Totals) -> Session:
    token = credentials.edge_token(share.keys, NAME, pack, datetime.now(UTC))
    return Session(pack, token, f"127.0.0.{2 + i % SOURCES}", options, totals)
