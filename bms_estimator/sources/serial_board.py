"""The board on a serial port: opened with pyserial, read when the descriptor has bytes, opened again when it is lost."""

import asyncio
import math
import os
import time
from collections.abc import AsyncIterator, Callable, Mapping
from types import TracebackType
from typing import Protocol, Self

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import SensorSettings
from bms_estimator.sources.decoder import make_decoder
from bms_estimator.sources.ports import NoPortError, open_port, resolve_port
from bms_estimator.sources.protocol import (
    Ack,
    AckResult,
    MessageType,
    hello_command,
    set_rate_command,
    zero_current_command,
)

FIRST_RETRY_S = 0.5
"""Before a missing or lost port is tried again; doubles with each attempt [s]."""
LONGEST_RETRY_S = 10.0
HELLO_S = 1.0
"""A board that has not said hello is asked again after this; its boot loader swallows the first requests [s]."""
SILENT_S = 3.0
"""Without a frame for so long the line is at fault [s]."""
JUNK_LOG_S = 30.0
"""Faults of the line are logged no more often than this [s]."""
ZERO_S = 4.0
"""The board measures for a second before it answers [s]."""
READ_BYTES = 1 << 16

_NO_FAULTS = ("bytes_received", "frames_received")

log = structlog.get_logger(__name__)


class Tap(Protocol):
    """Takes all that the decoder is fed, as ``CaptureWriter`` does."""

    def write(self, arrival_s: float, data: bytes) -> None:
        """Take one read of the descriptor."""


class SerialBoard:
    """Async source of SAMPLE blocks from a board.

    All that makes a sample passes ``decoder.feed(arrival_s, data)``: a capture of these calls replays to the same bits.
    Arrival times are the wall clock at start plus the monotonic clock since, so that they never step.

    Args:
        settings: Port, protocol, baud rate, sample rate.
        tap: Gets the same (arrival time, bytes) as the decoder.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: Before a missing or lost port is tried again [s].
        silent_s: Without a frame for so long the line is at fault [s].
    """

    def __init__(
        self,
        settings: SensorSettings,
        *,
        tap: Tap | None = None,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
        first_retry_s: float = FIRST_RETRY_S,
        silent_s: float = SILENT_S,
    ) -> None:
        self._settings, self._tap = settings, tap
        self._monotonic, self._epoch_s = monotonic, wall() - monotonic()
        self._first_retry_s, self._silent_s = first_retry_s, silent_s
        make_decoder(settings).feed(0.0, b"\0\n")  # loads its kernel: nothing compiles once bytes come
        self._decoder = make_decoder(settings)
        self._reads: asyncio.Queue[tuple[float, bytes] | None] = asyncio.Queue()
        self._message: str | None = "not opened yet"
        self._descriptor: int | None = None
        self._lost = asyncio.Event()
        self._opened = 0
        self._logged_s = -math.inf
        self._logged_faults = 0
        self._zeroed: asyncio.Future[Ack] | None = None
        self._decoded = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """The decoder's, and ``reconnects``."""
        return self._decoder.counters.as_dict() | {"reconnects": max(self._opened - 1, 0)}

    @property
    def message(self) -> str | None:
        """Why no samples come; None when they do."""
        return self._message

    @property
    def board(self) -> Mapping[str, str]:
        """What the board said of itself."""
        return self._decoder.board

    @property
    def clock_ppm(self) -> float | None:
        """How much faster the board's clock runs than the monotonic one."""
        return self._decoder.clock_ppm

    async def __aenter__(self) -> Self:
        """Begin to open the port; it need not be there yet."""
        self._task = asyncio.create_task(self._stay_open(), name="serial board")
        self._task.add_done_callback(lambda _: self._reads.put_nowait(None))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def __aiter__(self) -> AsyncIterator[SampleBlock]:
        """Blocks as the descriptor brings them.

        What the tap gets is what has been yielded: nothing is recorded that the caller has not taken.
        """
        while (read := await self._reads.get()) is not None:
            block = self._decode(*read)
            if block.size:
                self._message = None
                yield block
        if self._task is not None and not self._task.cancelled():
            self._task.result()

    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        if self._tap is not None:
            try:
                self._tap.write(arrival_s, data)
            except OSError as error:  # a full disk does not end the estimate
                log.warning("recording ended", reason=str(error))
                self._tap = None
        block = self._decoder.feed(arrival_s, data)
        for ack in self._decoder.take_acks():
            if ack.command == MessageType.COMMAND_ZERO_CURRENT and self._zeroed and not self._zeroed.done():
                self._zeroed.set_result(ack)
        self._decoded.set()
        return block

    async def current_zero(self) -> None:
        """Have the board take the present current as zero, for good: nothing may flow meanwhile.

        Samples after it are decoded with the new zero. Somebody must iterate over the blocks meanwhile.

        Raises:
            UserError: The board is not connected, does not answer, or refuses.
        """
        if self._settings.protocol == "text":
            raise UserError("a board that prints text takes no commands")
        if self._descriptor is None:
            raise UserError(f"the board is not connected: {self._message}")
        self._zeroed = asyncio.get_running_loop().create_future()
        self._send(zero_current_command())
        try:
            async with asyncio.timeout(ZERO_S):
                ack = await self._zeroed
                if ack.result == AckResult.OK:
                    await self._learn_zero(ack.value)
        except TimeoutError:
            raise UserError(f"the board has not answered within {ZERO_S:.0f} s") from None
        if ack.result != AckResult.OK:
            raise UserError(
                f"the board refuses: {ack.result.name.lower().replace('_', ' ')}; is the sensor connected, and no current flowing?"
            )

    async def _learn_zero(self, zero_ppm: int) -> None:
        """Until the hello that holds the board's new zero has come: the decoder knows no other way to it."""
        self._decoder.forget_hello()  # one that is lost is asked for again
        self._send(hello_command())
        while self._decoder.hello is None or self._decoder.hello.current_zero_ppm != zero_ppm:
            self._decoded.clear()
            await self._decoded.wait()

    async def _stay_open(self) -> None:
        """Open, attend until lost, and again after a pause that doubles."""
        retry_s = self._first_retry_s
        while True:
            try:
                path = resolve_port(self._settings.port)
                line = open_port(path, self._settings.baud)
            except (NoPortError, OSError) as error:
                self._say(f"waiting for {error}")
                await asyncio.sleep(retry_s)
                retry_s = min(2.0 * retry_s, LONGEST_RETRY_S)
                continue
            retry_s = self._first_retry_s
            self._descriptor = line.fileno()
            try:
                await self._attend(path, self._descriptor)
            finally:
                asyncio.get_running_loop().remove_reader(self._descriptor)
                self._descriptor = None
                line.close()
            self._say(f"{path}: lost, opening it again")
            await asyncio.sleep(retry_s)

    async def _attend(self, path: str, descriptor: int) -> None:
        """Read until the port is lost; meanwhile ask for what the board has not said."""
        self._opened += 1
        self._lost.clear()
        self._decoder.forget_hello()  # it may be another board, or the same one after a reset
        self._message = f"{path}: open, no frame yet"
        log.info("port opened", port=path, baud=self._settings.baud)
        asyncio.get_running_loop().add_reader(descriptor, self._read, descriptor)
        heard_s, frames = self._monotonic(), self._frames()
        while not self._lost.is_set():
            self._ask()
            await self._pause(HELLO_S)
            now_s = self._monotonic()
            if self._frames() != frames:
                heard_s, frames = now_s, self._frames()
            elif fault := self._decoder.fault:
                self._say(f"{path} at {self._settings.baud} baud: {fault.value}")
            elif now_s - heard_s >= self._silent_s:
                self._say(f"{path}: open, but silent")
            self._log_faults()

    async def _pause(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._lost.wait()
        except TimeoutError:
            return

    def _read(self, descriptor: int) -> None:
        """The descriptor has bytes, or has died."""
        arrival_s = self._epoch_s + self._monotonic()
        try:
            data = os.read(descriptor, READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            asyncio.get_running_loop().remove_reader(descriptor)
            self._lost.set()
            return
        self._reads.put_nowait((arrival_s, data))

    def _ask(self) -> None:
        """Ask a binary board for its hello, then for the wanted rate."""
        if self._settings.protocol == "text":
            return
        if self._decoder.hello is None:
            self._send(hello_command())
        elif self._decoder.hello.rate_hz != self._settings.sample_rate_hz:
            self._send(set_rate_command(self._settings.sample_rate_hz))
            self._send(hello_command())

    def _frames(self) -> int:
        return self._decoder.counters.frames_received

    def _send(self, frame: bytes) -> None:
        """Write a command. One that a dying port does not take is asked again after it is back."""
        if self._descriptor is None:
            return
        try:
            os.write(self._descriptor, frame)
        except OSError as error:
            log.warning("command not sent", reason=str(error))

    def _say(self, message: str) -> None:
        """Say why no samples come, once for each reason."""
        if message != self._message:
            log.warning("no samples", reason=message)
        self._message = message

    def _log_faults(self) -> None:
        """Log that the line has new faults, rarely."""
        counted = {name: n for name, n in self._decoder.counters.as_dict().items() if name not in _NO_FAULTS and n}
        faults = sum(counted.values())
        now_s = self._monotonic()
        if faults != self._logged_faults and now_s - self._logged_s >= JUNK_LOG_S:
            self._logged_faults, self._logged_s = faults, now_s
            log.warning("faults on the line", **counted)
