"""One run of a hook's program: its environment, its time limit, and the end of every process that it started.

Descendants are found by the program's session, by a random mark in their environment and by their parents. Only a process
that has left the session, cleared its environment and lost its parent is not found; a transient systemd scope would find it,
but needs rights on the system bus that the service does not have.
"""

import asyncio
import contextlib
import errno
import os
import secrets
import signal
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

PASSED = ("PATH", "HOME", "USER", "LOGNAME", "SHELL", "LANG", "TZ", "TMPDIR")
"""Environment variables of the service that every program gets, beside ``LC_*``. Others may hold secrets of the service."""
MARK = "BMS_HOOK_RUN"
"""Environment variable with a random value that marks all processes of one run."""
POLL_S = 0.05
"""Interval between two searches for descendants [s]."""
KILL_S = 5.0
"""Time limit for killing: a process in a hanging system call ends later [s]."""


class StartError(Exception):
    """The program could not be started."""


def environment(passed: Collection[str], fields: Mapping[str, str]) -> dict[str, str]:
    """Environment of a program.

    Args:
        passed: Names of further variables of the service that it gets.
        fields: Fields of the alarm; each becomes ``BMS_`` and its name in capitals. A null character in a foreign
            text becomes a space, because no program can be started with it.
    """
    names = {*PASSED, *passed}
    inherited = {name: value for name, value in os.environ.items() if name in names or name.startswith("LC_")}
    return inherited | {f"BMS_{name.upper()}": value.replace("\0", " ") for name, value in fields.items()}


async def run(command: Sequence[str], text: bytes, variables: Mapping[str, str], timeout_s: float) -> int | None:
    """Run a program until it and all its descendants have ended.

    Args:
        command: The program and its arguments.
        text: Standard input.
        variables: Environment.
        timeout_s: All that still runs after this time is killed [s].

    Returns:
        Exit code of the program; None if something was killed.

    Raises:
        StartError: It cannot be started.
    """
    mark = secrets.token_hex(8)
    try:
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            env={**variables, MARK: mark},
            start_new_session=True,
        )
    except (OSError, ValueError, RuntimeError, MemoryError) as error:
        raise StartError(str(error) or repr(error)) from None
    entry = f"{MARK}={mark}".encode()
    try:
        async with asyncio.timeout(timeout_s):
            await process.communicate(text)
            while await _find(process.pid, entry) != []:  # noqa: ASYNC110 - no event tells of a grandchild's end
                await asyncio.sleep(POLL_S)
    except TimeoutError:
        return None
    finally:
        await _kill(process, entry)
    return process.returncode


async def _kill(process: asyncio.subprocess.Process, entry: bytes) -> None:
    """Kill the program and its descendants that still run."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(KILL_S):
            while (found := await _find(process.pid, entry)) != []:
                if found is None and process.returncode is None:  # until then the number is that of its group
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.killpg(process.pid, signal.SIGKILL)
                for pid in found or ():
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(pid, signal.SIGKILL)
                await asyncio.sleep(POLL_S)
            await process.wait()


async def _find(leader: int, entry: bytes) -> list[int] | None:
    """Find the processes of a run; None if that is not possible now."""
    try:
        return await asyncio.to_thread(_processes, leader, entry)
    except (OSError, RuntimeError):  # no free descriptor, no further thread
        return None


def _processes(leader: int, entry: bytes) -> list[int]:
    """Return processes in the session of ``leader`` whose environment has ``entry``, and their descendants.

    Raises:
        OSError: No descriptor is free.
    """
    parents: dict[int, int] = {}
    found: set[int] = set()
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        pid = int(folder.name)
        try:
            state, parent, _group, session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if state in "ZX":  # it has ended
                continue
            parents[pid] = int(parent)
            if int(session) == leader or entry in (folder / "environ").read_bytes().split(b"\0"):
                found.add(pid)
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                raise
    while new := {pid for pid, parent in parents.items() if parent in found and pid not in found}:
        found |= new
    return sorted(found)
