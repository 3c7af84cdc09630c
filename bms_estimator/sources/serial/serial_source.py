"""The board on a serial port: link and decoder of any protocol."""

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Self

import structlog

from bms_estimator.model.clock import since_boot
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import CellBlock, SampleBlock
from bms_estimator.process.backoff import FIRST_RETRY_S
from bms_estimator.protocols.base.device_protocol import Command, DeviceProtocol
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.fault_log import FaultLog
from bms_estimator.sources.serial.board_check import BoardCheck, OtherBoardError
from bms_estimator.sources.serial.known_board_file import KnownBoardFile
from bms_estimator.sources.serial.port_discovery import BUSY_PORT_RETRY_S, WRONG_PORT_RETRY_S, PortDiscovery
from bms_estimator.sources.serial.port_list import NoPortError, open_port
from bms_estimator.sources.serial.serial_port import SerialPort
from bms_estimator.sources.source import Chunk, ReadTap, SourceHealth

if TYPE_CHECKING:
    import serial

TALK_S = 0.25
"""Interval at which due bytes are sent [s]."""
TALKS = 4
"""Number of these intervals between two checks for samples."""
SILENT_S = 3.0
"""Time without a frame that counts as a fault of the line [s]."""
SILENT_PERIODS = 3.0
"""Number of sample periods without a frame that counts as a fault, for slower devices."""
ANSWER_S = 4.0
"""A board measures for a second before it answers a command [s]."""

log = structlog.get_logger(__name__)


class SerialSource:
    """Async source of SAMPLE blocks from a board.

    All that makes a sample passes ``decoder.feed(arrival_s, data)``: a capture of these calls replays to the same bits.
    It stays with the pack's board, and searches other ports for it (``BoardCheck``, ``PortDiscovery``).

    Args:
        settings: Port, protocol, baud rate, sample rate.
        memory: Stores the pack's board, if it has a serial number; None: it is known for this run only.
        tap: Gets the same (arrival time, bytes) as the decoder.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: Delay before a missing or lost port is retried [s].
        silent_s: Time without a frame that counts as a fault of the line [s].
    """

    def __init__(
        self,
        settings: SensorSettings,
        *,
        memory: KnownBoardFile | None = None,
        tap: ReadTap | None = None,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = since_boot,
        first_retry_s: float = FIRST_RETRY_S,
        silent_s: float = SILENT_S,
    ) -> None:
        self._settings, self._tap = settings, tap
        slow_s = settings.period_s or 0.0
        self._silent_s = max(silent_s, SILENT_PERIODS * slow_s if slow_s > 1.0 else 0.0)
        self._monotonic = monotonic
        make_protocol(settings).feed(0.0, b"\0\n")  # loads its kernel, so that nothing compiles once bytes arrive
        self._decoder = make_protocol(settings)
        tells_serial = settings.protocol == "binary"  # boards that print text cannot be distinguished
        self._door = BoardCheck(
            lambda: make_protocol(settings), settings.serial or "", memory if tells_serial else None
        )
        self._where = PortDiscovery(settings.port, monotonic)
        self._line = SerialPort(
            self._open_next,
            say=self._report,
            wall=wall,
            monotonic=monotonic,
            first_retry_s=first_retry_s,
        )
        self._message: str | None = "not opened yet"
        self._openings = 0  # of the line, as far as its reads have been taken
        self._refused = False  # the message gives the reason why the device is rejected
        self._path = ""  # of the port that is open
        self._tended_s = monotonic()  # when the task last turned
        self._arrived_s = math.nan  # of the last block's bytes, on the line's clock
        self._faults = FaultLog()
        self._decoded = asyncio.Event()
        self._asking = asyncio.Lock()
        self._task: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the decoder, ``unadmitted_bytes`` of the board check, ``reconnects``, and ``missed_reads`` of a tap."""
        counters = {
            **self._decoder.counters,
            "unadmitted_bytes": self._door.unadmitted_bytes,
            "reconnects": max(self._line.openings - 1, 0),
        }
        return counters if self._tap is None else counters | {"missed_reads": self._tap.missed_reads}

    @property
    def message(self) -> str | None:
        """Reason why no samples arrive; None when they do."""
        return self._message

    @property
    def board(self) -> Mapping[str, str]:
        """Hello of the board."""
        return self._decoder.board

    @property
    def cells(self) -> CellBlock:
        """Beside the samples of the last block."""
        return self._decoder.cells

    @property
    def clock_ppm(self) -> float | None:
        """Rate of the board's clock over the monotonic one [1e-6]."""
        return self._decoder.clock_ppm

    def pulse(self) -> SourceHealth:
        """Health of line and task."""
        now_s = self._line.now_s
        return SourceHealth(self._monotonic() - self._tended_s, now_s - self._arrived_s, self._line.waiting)

    async def __aenter__(self) -> Self:
        """Begin to open the port; it need not be there yet."""
        self._task = asyncio.create_task(self._stay_open(), name="serial board")
        self._task.add_done_callback(lambda _: self._line.finish())
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the port."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def __aiter__(self) -> AsyncIterator[SampleBlock]:
        """Blocks as the descriptor brings them.

        The tap receives the chunks of yielded blocks, so nothing is recorded that the caller has not taken.
        """
        while (read := await self._line.read()) is not None:
            for arrival_s, data in self._admit(read):
                block = self._decode(arrival_s, data)
                if block.size:
                    self._arrived_s = arrival_s
                    if self._message is not None:
                        self._message, self._refused = None, False
                        self._line.confirm()
                    yield block
        if self._task is not None and not self._task.cancelled():
            self._task.result()

    def _admit(self, read: Chunk) -> Sequence[Chunk]:
        """Return the chunks to decode now."""
        if not read[1]:
            self._openings += 1
            self._decoder.on_port_opened()
            self._door.opened()
            return ()
        try:
            return self._door.accept(read, self._decoder)
        except OtherBoardError as error:
            self._leave(f"{self._path}: refused: {error}")
            return ()

    def _leave(self, message: str) -> None:
        """Reject the device on the port and search elsewhere."""
        self._report(message)
        self._refused = True
        self._where.skip_port(self._path, WRONG_PORT_RETRY_S)
        self._line.lost.set()

    @property
    def _listener(self) -> DeviceProtocol:
        """Return the decoder of the device that was received last."""
        return self._door.pending_protocol or self._decoder

    def _send_due(self) -> None:
        """Send pending commands to the last device, if it is the one on the port now."""
        if self._openings == self._line.openings and not self._line.lost.is_set():
            self._line.send(self._listener.next_output(self._line.now_s))

    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        if self._tap is not None:
            self._tap.write(arrival_s, data)
        block = self._decoder.feed(arrival_s, data)
        self._decoded.set()
        return block

    async def current_zero(self) -> None:
        """Let the board take the present current as zero permanently: disconnect the load first.

        Samples after it are decoded with the new zero. The blocks must be iterated over meanwhile.

        Raises:
            UserError: The board is not connected, takes no commands, does not answer, or refuses.
        """
        await self._ask(lambda: self._decoder.command("current_zero"))

    async def relay(self, relay: Relay) -> None:
        """Have the board set its relay pin; the blocks must be iterated over meanwhile.

        Raises:
            UserError: As ``current_zero``.
        """
        await self._ask(lambda: self._decoder.relay(relay))

    async def _ask(self, ask: Callable[[], Command]) -> None:
        """Have a command given, after those before it, and wait for its answer.

        Raises:
            UserError: As ``current_zero``.
        """
        async with self._asking:
            await self._answer(ask())

    async def _answer(self, command: Command) -> None:
        """Wait for the answer to a command.

        Raises:
            UserError: As ``current_zero``.
        """
        try:
            if not self._line.is_open:
                raise UserError(f"the board is not connected: {self._message}")
            self._send_due()
            async with asyncio.timeout(ANSWER_S):
                while not command.done:
                    self._decoded.clear()
                    await self._decoded.wait()
        except TimeoutError:
            raise UserError(f"the board has not answered within {ANSWER_S:.0f} s") from None
        finally:
            command.done = True
        if command.refusal:
            raise UserError(command.refusal)

    def _open_next(self) -> tuple[str, "serial.Serial"]:
        """Open the port on which the board may be.

        Raises:
            NoPortError: No such port, or it cannot be opened.
        """
        path = self._where.next(self._door.serial)
        try:
            return path, open_port(path, self._settings.baud)
        except NoPortError:
            self._where.skip_port(path, BUSY_PORT_RETRY_S)
            raise

    async def _stay_open(self) -> None:
        """Open, attend until lost, and again."""
        while True:
            if self._refused:
                self._door.reload_known_board()
            path = self._path = await self._line.open()
            try:
                await self._attend(path)
            finally:
                self._line.close()
            if not self._refused:
                self._report(f"{path}: lost, opening it again")

    async def _attend(self, path: str) -> None:
        """Watch the line until it is lost."""
        if not self._refused:
            self._message = f"{path}: open, no frame yet"
            log.info("port opened", port=path, baud=self._settings.baud)
        heard_s, frames = self._monotonic(), self._decoder.counters["frames_received"]
        while not self._line.lost.is_set():
            await self._talk()
            now_s = self._monotonic()
            counters = self._decoder.counters
            if counters["frames_received"] != frames:
                heard_s, frames = now_s, counters["frames_received"]
                self._door.remember_board(self.board, now_s)
            elif self._refused:
                continue
            elif fault := self._listener.fault:
                self._report_or_leave(f"{path} at {self._settings.baud} baud: {fault}")
            elif now_s - heard_s >= max(self._silent_s, self._listener.allowed_silence_s):
                self._report_or_leave(f"{path}: open, but silent")
            self._faults.check(counters, now_s)

    def _report_or_leave(self, message: str) -> None:
        """Report why no samples arrive, and try other ports if the board may be elsewhere."""
        if self._where.is_preferred:
            self._report(message)
        else:
            self._leave(message)

    async def _talk(self) -> None:
        """Send due commands until the next check, or until the link is lost."""
        for _ in range(TALKS):
            self._tended_s = self._monotonic()
            self._send_due()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TALK_S):
                    await self._line.lost.wait()
                    return

    def _report(self, message: str) -> None:
        """Report why no samples arrive, once for each reason."""
        self._tended_s = self._monotonic()
        if message != self._message:
            log.warning("no samples", reason=message)
        self._message, self._refused = message, False
