"""One run of a hook's program: environment, time limit, and termination of all processes that it started.

Descendants are found by their session, by a random mark in their environment, and by their parents. A process that has left
the session, cleared its environment and lost its parent is not found. A transient systemd scope would find it, but needs
rights on the system bus that the service does not have.
"""

import asyncio
import contextlib
import errno
import os
import secrets
import signal
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

INHERITED_VARIABLES = ("PATH", "HOME", "USER", "LOGNAME", "SHELL", "LANG", "TZ", "TMPDIR")
"""Environment variables of the service that every program inherits, besides ``LC_*``. Others may hold secrets."""
MARK_VARIABLE = "BMS_HOOK_RUN"
"""Environment variable with a random value that marks all processes of one run."""
POLL_INTERVAL_S = 0.05
"""Interval between two searches for descendants [s]."""
KILL_TIMEOUT_S = 5.0
"""Time limit for killing [s]. A process that hangs in a system call may end later."""


class StartError(Exception):
    """The program could not be started."""


def program_environment(passed: Collection[str], fields: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a program.

    Args:
        passed: Names of variables of the service that the program inherits besides ``INHERITED_VARIABLES``.
        fields: Fields of the alarm; each becomes a variable named ``BMS_`` and the name in capitals. A null character
            becomes a space, because no program can be started with it.
    """
    names = {*INHERITED_VARIABLES, *passed}
    inherited = {name: value for name, value in os.environ.items() if name in names or name.startswith("LC_")}
    return inherited | {f"BMS_{name.upper()}": value.replace("\0", " ") for name, value in fields.items()}


async def run_program(
    command: Sequence[str], stdin: bytes, variables: Mapping[str, str], timeout_s: float
) -> int | None:
    """Run a program until it and all its descendants have ended.

    Args:
        command: The program and its arguments.
        stdin: Standard input.
        variables: Environment.
        timeout_s: Time after which the program and its descendants are killed [s].

    Returns:
        Exit code of the program; None if a process was killed.

    Raises:
        StartError: The program cannot be started.
    """
    mark = secrets.token_hex(8)
    try:
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            env={**variables, MARK_VARIABLE: mark},
            start_new_session=True,
        )
    except (OSError, ValueError, RuntimeError, MemoryError) as error:
        raise StartError(str(error) or repr(error)) from None
    marked_variable = f"{MARK_VARIABLE}={mark}".encode()
    try:
        async with asyncio.timeout(timeout_s):
            await process.communicate(stdin)
            # polled, because the end of a grandchild causes no event
            while await _find_processes(process.pid, marked_variable) != []:  # noqa: ASYNC110
                await asyncio.sleep(POLL_INTERVAL_S)
    except TimeoutError:
        return None
    finally:
        await _kill(process, marked_variable)
    return process.returncode


async def _kill(process: asyncio.subprocess.Process, marked_variable: bytes) -> None:
    """Kill the program and its descendants."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(KILL_TIMEOUT_S):
            while (pids := await _find_processes(process.pid, marked_variable)) != []:
                # without a list, kill the process group, which exists while the program runs
                if pids is None and process.returncode is None:
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.killpg(process.pid, signal.SIGKILL)
                for pid in pids or ():
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.kill(pid, signal.SIGKILL)
                await asyncio.sleep(POLL_INTERVAL_S)
            await process.wait()


async def _find_processes(leader: int, marked_variable: bytes) -> list[int] | None:
    """Return the processes of a run; None if no list can be made at the moment."""
    try:
        return await asyncio.to_thread(_list_processes, leader, marked_variable)
    except (OSError, RuntimeError):  # no file descriptor or thread is available
        return None


def _list_processes(leader: int, marked_variable: bytes) -> list[int]:
    """Return the processes in the session of ``leader``, those with ``marked_variable``, and the descendants of both.

    Raises:
        OSError: No file descriptor is free.
    """
    parents: dict[int, int] = {}
    found: set[int] = set()
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        pid = int(folder.name)
        try:
            state, parent, _group, session = (folder / "stat").read_bytes().rpartition(b")")[2].split()[:4]
            if state in b"ZX":  # zombie or dead
                continue
            parents[pid] = int(parent)
            if int(session) == leader or marked_variable in (folder / "environ").read_bytes().split(b"\0"):
                found.add(pid)
        except OSError as error:  # the process has ended, or belongs to another user
            if error.errno in (errno.EMFILE, errno.ENFILE):
                raise
    while new := {pid for pid, parent in parents.items() if parent in found and pid not in found}:
        found |= new
    return sorted(found)
