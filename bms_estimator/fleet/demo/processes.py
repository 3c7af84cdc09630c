"""Child processes of the demo of a fleet, and free ports for them."""

import asyncio
import contextlib
import itertools
import random
import socket
import sys
import time
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import IO, TypeVar

from bms_estimator.model.errors import UserError
from bms_estimator.process.child_process import terminate_with_parent

LOOPBACK = "127.0.0.1"
"""Address on which all processes listen."""
TIMEOUT_S = 120.0
"""Timeout of a start, a takeover and the last blocks [s], which normally take seconds."""
POLL_S = 0.1
"""Interval at which a condition is checked [s]."""
_PORTS = range(20_000, 32_768)
"""Range of ports for the servers. It lies below the ports of outgoing connections, which could occupy a port before a
server listens on it."""
_COMMAND = (sys.executable, "-c", "from bms_estimator.cli.main import main; main()", "fleet")
T = TypeVar("T")
_port_offsets = itertools.count(random.randrange(len(_PORTS)))


class Processes:
    """Processes of ``fleet`` commands; each writes its output to a file in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: dict[str, asyncio.subprocess.Process] = {}

    async def start(self, name: str, *arguments: object) -> asyncio.subprocess.Process:
        """Start a command."""
        with (self.folder / f"{name}.log").open("ab") as log:
            process = await _start_process(arguments, stdout=log, stderr=log)
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

    async def output(self, *arguments: object) -> str | None:
        """Return the output of a command; None if it fails."""
        process = await _start_process(arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL)
        output, _ = await process.communicate()
        return None if process.returncode else output.decode()

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition.

        Raises:
            UserError: A process has ended, or the wait has timed out.
        """

        async def read() -> bool | None:
            return condition() or None

        await self.poll(read)

    async def poll(self, read: Callable[[], Awaitable[T | None]]) -> T:
        """Read repeatedly until the result is not None, and return it.

        Raises:
            UserError: A process has ended, or the wait has timed out.
        """
        end_s = time.monotonic() + TIMEOUT_S
        while (result := await read()) is None:
            self.check()
            if time.monotonic() > end_s:
                raise UserError(f"the demo timed out after {TIMEOUT_S:g} s; running: {', '.join(self._running)}")
            await asyncio.sleep(POLL_S)
        return result

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
        """Stop all processes, the first one last, because it is the server."""
        await asyncio.gather(*(self.stop(name) for name in list(self._running)[1:]))
        for name in list(self._running):
            await self.stop(name)

    def _ended(self, name: str) -> UserError:
        lines = (self.folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return UserError(f"{name} has ended: {lines[-1] if lines else 'without output'}")


async def _start_process(
    arguments: Iterable[object], *, stdout: int | IO[bytes], stderr: int | IO[bytes]
) -> asyncio.subprocess.Process:
    """Start a command in a new session, so that Ctrl-C reaches only this process, which ends the others."""
    return await asyncio.create_subprocess_exec(
        *_COMMAND,
        *map(str, arguments),
        stdout=stdout,
        stderr=stderr,
        start_new_session=True,
        preexec_fn=terminate_with_parent(),
    )


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
