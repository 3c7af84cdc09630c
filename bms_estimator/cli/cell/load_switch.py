"""Switch of the load in a calibration: the relay of the sensor board, or a program."""

import asyncio
import contextlib
import shlex
import shutil
from collections.abc import Awaitable, Callable

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.service.hook_process import StartError, program_environment, run_program

REPEAT_S = 2.0
"""Interval between two commands with the same level [s]. They are repeated because a board may have been reset."""
PROGRAM_TIMEOUT_S = 10.0
"""Timeout of the program [s]."""
RELEASE_ATTEMPTS = 3
"""Number of attempts to disconnect the load at the end."""

SetLoad = Callable[[bool], Awaitable[None]]
"""Function that connects (True) or disconnects the load, or raises UserError."""

log = structlog.get_logger(__name__)


def board_relay(relay: Callable[[Relay], Awaitable[None]], *, high_is_on: bool, silent_s: int) -> SetLoad:
    """Return a function that switches the load with the relay of the board.

    Args:
        relay: Sends a relay command.
        high_is_on: True if the high level connects the load.
        silent_s: Time without a command after which the board disconnects the load by itself [s].
    """

    async def set_load(on: bool) -> None:
        await relay(Relay(high=on == high_is_on, high_when_silent=not high_is_on, silent_s=silent_s))

    return set_load


def relay_program(command: str) -> SetLoad:
    """Return a function that switches the load with a program, which is called with the argument ``on`` or ``off``.

    Raises:
        UserError: The program does not exist, or may not be run.
    """
    try:
        program = shlex.split(command)
    except ValueError as error:
        raise UserError(f"--relay-command {command}: {error}") from None
    if not program or shutil.which(program[0]) is None:
        raise UserError(f"--relay-command {command}: no such program here, or it may not be run")

    async def set_load(on: bool) -> None:
        arguments = [*program, "on" if on else "off"]
        try:
            code = await run_program(arguments, b"", program_environment((), {}), PROGRAM_TIMEOUT_S)
        except StartError as error:
            raise UserError(f"{shlex.join(arguments)}: {error}") from None
        if code != 0:
            outcome = "was killed after its timeout" if code is None else f"exit code {code}"
            raise UserError(f"{shlex.join(arguments)}: {outcome}")

    return set_load


class LoadSwitch:
    """Switch that sends the requested state of the load, and sends it again after a failure.

    Args:
        set_load: Connects or disconnects the load.
        repeat: Repeat the command at intervals, for a board that may be reset.
    """

    def __init__(self, set_load: SetLoad, *, repeat: bool) -> None:
        self._set_load, self._repeat = set_load, repeat
        self._on, self._wake = False, asyncio.Event()
        self._was_connected = False
        self.error = ""
        """Reason why the last command failed; empty after a success."""

    def request(self, on: bool) -> None:
        """Request a state; returns at once."""
        if on != self._on:
            self._on = on
            self._wake.set()

    async def run(self) -> None:
        """Send the requested state whenever it changes, after failures, and at intervals. Runs until cancelled."""
        while True:
            self._wake.clear()
            await self._send(self._on)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(REPEAT_S if self._repeat or self.error else None):
                    await self._wake.wait()

    async def release(self) -> None:
        """Disconnect the load; raises UserError if that fails after the load was connected."""
        for _ in range(RELEASE_ATTEMPTS):
            await self._send(on=False)
            if not self.error or not self._was_connected:
                return
        raise UserError(f"the load could not be disconnected: {self.error}; disconnect it now")

    async def _send(self, on: bool) -> None:
        self._was_connected |= on
        try:
            await self._set_load(on)
            self.error = ""
        except UserError as error:
            if str(error) != self.error:
                log.warning("the load cannot be switched", reason=str(error))
            self.error = str(error)
