"""Attack with idle connections on the HTTP listeners of programs with the usual limit of 1,024 open files."""

import asyncio
import contextlib
import json
import resource
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import aiohttp

from tests.fleet.nats_cluster import NatsCluster
from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.page.house import Service, start_program
from tests.patience import LONG_S, until

DESCRIPTORS = 1024
"""Soft limit of open files of a process on most systems."""
IDLE_CONNECTIONS = DESCRIPTORS
"""Number of idle connections to each listener, which equals the limit of descriptors."""
ATTACKER_PROGRAM = """
import resource, socket, sys
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
idle = [socket.create_connection(("127.0.0.1", int(port))) for port in sys.argv[2:] for _ in range(int(sys.argv[1]))]
print("open", flush=True)
sys.stdin.read()
"""
"""Program of the attacker, which runs as a process with its own limit of descriptors.

Its arguments are the number of connections to each port, and the ports. It prints "open" once all connections are open.
"""
BOARD_VALUES = {"voltage": 13.276, "current": 2.5, "temperature": 21.5, "cells": [3.311, 3.325, 3.318, 3.322]}
PACK = 'cell = "lfp"\ncapacity_ah = 100\nseries = 4\ninitial_soc = 0.6'


class Outcome(NamedTuple):
    """Behavior of a program while idle connections are open."""

    answers: list[int]
    """HTTP status that each listener answered."""
    tracebacks: int
    log_lines: int


@contextlib.contextmanager
def few_descriptors() -> Iterator[None]:
    """Limit the descriptors of this process, and of processes that it starts, to ``DESCRIPTORS``."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@contextlib.asynccontextmanager
async def hold_idle_connections(*ports: int) -> AsyncIterator[None]:
    """Hold ``IDLE_CONNECTIONS`` connections to each port."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        ATTACKER_PROGRAM,
        str(IDLE_CONNECTIONS),
        *map(str, ports),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stdout
        async with asyncio.timeout(LONG_S):
            assert await process.stdout.readline() == b"open\n"
        yield
    finally:
        process.kill()
        await process.wait()


async def attack_service(folder: Path, broker: Broker) -> Outcome:
    """Attack page and Prometheus exporter of the real service.

    Return after the service has saved checkpoints and reconnected to the restarted broker.
    """
    port, exporter = free_port(), free_port()
    # The first line belongs to the section [state], which precedes it in the settings of ``Service``.
    extra_toml = f'checkpoint_s = 1\n[prometheus]\nlisten = "127.0.0.1:{exporter}"\n'
    service = Service(folder, broker, port, lambda _: BOARD_VALUES, pack=PACK, more=extra_toml)
    async with service:
        async with Listener(broker) as live:
            await live.wait_json("bms/attic/state")
        async with hold_idle_connections(port, exporter):
            await _wait_for_checkpoint(folder)
            broker.stop()
            broker.start()
            async with Listener(broker) as live:
                await live.wait_json("bms/attic/state")
            await _wait_for_checkpoint(folder)
            return await _measure_outcome(
                folder, port, f"http://127.0.0.1:{port}/", f"http://127.0.0.1:{exporter}/metrics"
            )


async def attack_dashboard(folder: Path, broker: Broker) -> Outcome:
    """Attack the real ``dashboard``. Return after its page shows that it has reconnected to the broker."""
    port = free_port()
    arguments = ("--mqtt", broker.url, "--listen", f"127.0.0.1:{port}", "--folder", folder, "--no-browser")
    return await _attack_page(folder, port, ("dashboard", *arguments), broker.stop, broker.start)


async def attack_fleet_page(folder: Path, engine: NatsCluster) -> Outcome:
    """Attack the real ``fleet page``. Return after it has reconnected to the NATS server."""
    port = free_port()
    arguments = ("--server", engine.url, "--listen", f"127.0.0.1:{port}", "--no-browser")
    return await _attack_page(
        folder, port, ("fleet", "page", *arguments), partial(engine.kill, 0), partial(engine.start, 0)
    )


async def _attack_page(
    folder: Path, port: int, program: tuple[object, ...], stop: Callable[[], object], start: Callable[[], object]
) -> Outcome:
    """Attack the page that ``program`` serves; ``stop`` and ``start`` act on the server to which it is connected."""
    process = await start_program(folder, *program, port=port)
    url = f"http://127.0.0.1:{port}/"
    try:
        await _wait_for_link(url, up=True)
        async with hold_idle_connections(port):
            stop()
            await _wait_for_link(url, up=False)
            start()
            await _wait_for_link(url, up=True)
            return await _measure_outcome(folder, port, url)
    finally:
        process.terminate()
        await process.wait()


async def _wait_for_link(url: str, *, up: bool) -> None:
    """Read the page's stream until it reports the link to be up or down."""
    async with asyncio.timeout(LONG_S), aiohttp.ClientSession() as session, session.get(f"{url}events") as response:
        async for line in response.content:
            event = json.loads(line.removeprefix(b"data: ")) if line.startswith(b"data: ") else {}
            if event.get("link", {}).get("up") is up:
                return


async def _wait_for_checkpoint(folder: Path) -> None:
    """Wait for a checkpoint that is newer than the present one."""
    before = _checkpoint_time_s(folder)
    await until(lambda: _checkpoint_time_s(folder) > before)


def _checkpoint_time_s(folder: Path) -> float:
    return max((path.stat().st_mtime for path in folder.glob("attic-*")), default=0.0)


async def _measure_outcome(folder: Path, port: int, *urls: str) -> Outcome:
    """Request each URL, and count tracebacks and lines in the log of the program on ``port``."""
    answers = list[int]()
    async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(LONG_S)) as session:
        for url in urls:
            async with session.get(url) as response:
                answers.append(response.status)
    log = (folder / f"{port}.log").read_text()
    return Outcome(answers, log.count("Traceback"), log.count("\n"))
