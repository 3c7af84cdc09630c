"""Source of samples from a device on a serial port, with any device protocol."""

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Self

import structlog

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.clock import since_boot
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading_protocol import Command, DeviceProtocol
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.fault_log import FaultLog, SilenceLog
from bms_estimator.sources.serial.board_check import BoardCheck, OtherBoardError
from bms_estimator.sources.serial.port_list import KnownBoardFile, NoPortError, open_port
from bms_estimator.sources.serial.serial_port import (
    BUSY_PORT_RETRY_S,
    SILENT_PORT_RETRY_S,
    WRONG_PORT_RETRY_S,
    PortDiscovery,
    SerialPort,
)
from bms_estimator.sources.source import FIRST_RETRY_S, Chunk, ReadTap, ReceivedSamples, SourceHealth

if TYPE_CHECKING:
    import serial

SEND_INTERVAL_S = 0.25
"""Interval at which pending commands and queries are sent [s]."""
SENDS_PER_CHECK = 4
"""Number of send intervals between two checks for samples."""
SILENT_S = 3.0
"""Minimum time without a frame after which the line counts as silent [s]."""
SILENT_PERIODS = 3.0
"""Number of sample periods without a frame after which a device with a period above 1 s counts as silent."""
COMMAND_TIMEOUT_S = 4.0
"""Timeout of a command [s]. A board may measure for a second before it answers."""

log = structlog.get_logger(__name__)


class SerialSource:
    """Source of sample blocks from a device on a serial port.

    The samples depend only on the calls of ``decoder.feed(arrival_s, data)``. A capture of these calls therefore replays
    bit-identically. ``BoardCheck`` rejects other boards, and ``PortDiscovery`` searches other ports for the pack's board.

    Args:
        settings: Port, protocol, baud rate, sample rate.
        board_file: File that stores the pack's board. It is used only if the board reports a serial number. None: the board is
            not stored.
        tap: Receives each chunk with its arrival time, before the chunk is decoded.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: First delay before a missing or lost port is retried [s].
        silent_s: Time without a frame after which the line counts as silent [s].
    """

    conflict = ""
    """A port has no second publisher."""

    def __init__(
        self,
        settings: SensorSettings,
        *,
        board_file: KnownBoardFile | None = None,
        tap: ReadTap | None = None,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = since_boot,
        first_retry_s: float = FIRST_RETRY_S,
        silent_s: float = SILENT_S,
    ) -> None:
        self._settings, self._tap = settings, tap
        period_s = settings.period_s or 0.0
        self._silence_limit_s = max(silent_s, SILENT_PERIODS * period_s if period_s > 1.0 else 0.0)
        self._monotonic = monotonic
        make_protocol(settings).feed(0.0, b"\0\n")  # ends a frame, so that numba compiles the decoder now
        self._decoder = make_protocol(settings)
        has_serial_number = settings.protocol == "binary"  # other devices report no serial number
        self.board_check = BoardCheck(
            lambda: make_protocol(settings), settings.serial or "", board_file if has_serial_number else None
        )
        """Check that the board is the pack's."""
        self._discovery = PortDiscovery(settings.port, monotonic)
        self._port = SerialPort(
            self._find_and_open,
            report=self._report,
            wall=wall,
            monotonic=monotonic,
            first_retry_s=first_retry_s,
        )
        self._silence_reason: str | None = "not opened yet"
        self._openings_read = 0  # number of openings of the port whose chunks have been read
        self._rejected = False  # True from the rejection of a device until another reason for silence is set
        self._path = ""  # path of the open port
        self._last_check_s = monotonic()  # time of the last iteration of the task
        self._block_arrival_s = math.nan  # arrival time of the last block's bytes
        self._fault_log, self._silence_log = FaultLog(), SilenceLog()
        self._decoded = asyncio.Event()
        self._command_lock = asyncio.Lock()
        self._task: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the decoder, the board check and the tap, and the number of ``reconnects``."""
        counters = {
            **self._decoder.counters,
            "unadmitted_bytes": self.board_check.rejected_bytes,
            "reconnects": max(self._port.openings - 1, 0),
        }
        return counters if self._tap is None else counters | {"missed_reads": self._tap.missed_reads}

    @property
    def silence_reason(self) -> str | None:
        """Reason why no samples arrive; None while they arrive."""
        return self._silence_reason

    @property
    def board(self) -> Mapping[str, str]:
        """Properties from the board's hello; empty without one."""
        return self._decoder.board

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the board's clock relative to the host's [1e-6]; None if unknown."""
        return self._decoder.clock_ppm

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the device's clock; empty without one."""
        return self._decoder.clock_fault

    def health(self) -> SourceHealth:
        """Return the health of the port and its task."""
        now_s = self._port.now_s
        return SourceHealth(
            task_idle_s=self._monotonic() - self._last_check_s,
            block_age_s=now_s - self._block_arrival_s,
            queued_reads=self._port.queued_chunks,
        )

    async def __aenter__(self) -> Self:
        """Start the task that opens the port, which may not exist yet."""
        self._task = asyncio.create_task(self._stay_open(), name="serial board")
        self._task.add_done_callback(lambda _: self._port.finish())
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        """Yield blocks as bytes arrive.

        A chunk goes to the tap when its block is requested, so that nothing is recorded that the caller has not received.
        """
        while (chunk := await self._port.read()) is not None:
            for arrival_s, data in self._accepted_chunks(chunk):
                block = self._decode(arrival_s, data)
                if block.size:
                    self._block_arrival_s = arrival_s
                    if self._silence_reason is not None:
                        self._silence_reason, self._rejected = None, False
                        self._silence_log.on_samples(self._monotonic())
                        self._port.reset_backoff()
                    decoder = self._decoder
                    yield ReceivedSamples(
                        block, decoder.cells, decoder.probes, decoder.device_soc, decoder.device_capacity_ah
                    )
        if self._task is not None and not self._task.cancelled():
            self._task.result()

    def _accepted_chunks(self, chunk: Chunk) -> Sequence[Chunk]:
        """Return the chunks to decode now."""
        if not chunk[1]:  # an empty chunk marks an opening of the port
            self._openings_read += 1
            self._decoder.on_port_opened()
            self.board_check.on_port_opened()
            return ()
        try:
            return self.board_check.accept(chunk, self._decoder)
        except OtherBoardError as error:
            self._reject_device(f"{self._path}: refused: {error}", WRONG_PORT_RETRY_S)
            return ()

    def _reject_device(self, reason: str, retry_s: float) -> None:
        """Reject the device on the port, and prefer other ports for ``retry_s``."""
        self._report(reason)
        self._rejected = True
        self._discovery.skip_port(self._path, retry_s)
        self._port.lost.set()

    @property
    def _current_decoder(self) -> DeviceProtocol:
        """Decoder of the device whose bytes arrived last, which may still be pending."""
        return self.board_check.pending_protocol or self._decoder

    def _send_due(self) -> None:
        """Send the decoder's output, unless chunks from before the last opening of the port are still queued."""
        if self._openings_read == self._port.openings and not self._port.lost.is_set():
            self._port.send(self._current_decoder.next_output(self._port.now_s))

    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        if self._tap is not None:
            self._tap.write(arrival_s, data)
        block = self._decoder.feed(arrival_s, data)
        self._decoded.set()
        return block

    async def store_current_zero(self) -> None:
        """Make the board store the present current as zero. The load must be disconnected.

        Later samples are decoded with the new zero. Another task must iterate over the blocks meanwhile.

        Raises:
            UserError: The board is not connected, has no such command, does not answer, or rejects the command.
        """
        self.board_check.is_zero_commanded = True
        try:
            await self._run_command(lambda: self._decoder.command("current_zero"))
            self.board_check.remember_board(self.board, self._monotonic())
        finally:
            self.board_check.is_zero_commanded = False

    @property
    def boots(self) -> int:
        """Number of resets and exchanges of the board since start."""
        return self._decoder.boots

    async def relay(self, relay: Relay, boots: int | None = None) -> None:
        """Make the board set its relay pin. Another task must iterate over the blocks meanwhile.

        Args:
            relay: Level of the pin.
            boots: Value of ``boots`` for which the command is meant. After another reset it is not sent. None: any.

        Raises:
            UserError: The board is not connected, has no relay, does not answer, rejects the command or was reset.
        """

        def start() -> Command:
            if boots not in (None, self.boots):
                raise UserError("the board was reset before the command was sent")
            return self._decoder.relay(relay)

        await self._run_command(start)

    async def _run_command(self, start: Callable[[], Command]) -> None:
        """Start a command when earlier ones have ended, and wait for its answer.

        Raises:
            UserError: The board is not connected, does not answer, or rejects the command.
        """
        async with self._command_lock:
            await self._wait_for_answer(start())

    async def _wait_for_answer(self, command: Command) -> None:
        """Send a command and wait for its answer.

        Raises:
            UserError: The board is not connected, does not answer, or rejects the command.
        """
        try:
            if not self._port.is_open:
                raise UserError(f"the board is not connected: {self._silence_reason}")
            self._send_due()
            async with asyncio.timeout(COMMAND_TIMEOUT_S):
                while not command.done:
                    self._decoded.clear()
                    await self._decoded.wait()
                    self._send_due()
        except TimeoutError:
            raise UserError(f"the board has not answered within {COMMAND_TIMEOUT_S:.0f} s") from None
        finally:
            command.done = True  # cancels a command without an answer
        if command.refusal:
            raise UserError(command.refusal)

    def _find_and_open(self) -> tuple[str, "serial.Serial"]:
        """Open the next candidate port.

        Raises:
            NoPortError: There is no candidate, or it cannot be opened.
        """
        path = self._discovery.next(self.board_check.serial)
        try:
            return path, open_port(path, self._settings.baud)
        except NoPortError:
            self._discovery.skip_port(path, BUSY_PORT_RETRY_S)
            raise

    async def _stay_open(self) -> None:
        """Open the port, supervise it until it is lost, and repeat forever."""
        while True:
            if self._rejected:  # a user may have accepted another board since then
                self.board_check.reload_known_board()
            path = self._path = await self._port.open()
            try:
                await self._supervise(path)
            finally:
                self._port.close()
            if not self._rejected:
                self._report(f"{path}: lost, reopening it")

    async def _supervise(self, path: str) -> None:
        """Report silence and faults until the port is lost."""
        if not self._rejected:
            self._silence_reason = f"{path}: open, no frame yet"
            log.info("port opened", port=path, baud=self._settings.baud)
        last_frame_s, frames = self._monotonic(), self._decoder.counters["frames_received"]
        while not self._port.lost.is_set():
            await self._send_until_check()
            now_s = self._monotonic()
            counters = self._decoder.counters
            if counters["frames_received"] != frames:
                last_frame_s, frames = now_s, counters["frames_received"]
                self.board_check.remember_board(self.board, now_s)
            elif self._rejected:  # the reason is already reported
                continue
            elif fault := self._current_decoder.fault:
                self._report_or_reject(f"{path} at {self._settings.baud} baud: {fault}", WRONG_PORT_RETRY_S)
            elif now_s - last_frame_s >= max(self._silence_limit_s, self._current_decoder.allowed_silence_s):
                self._report_or_reject(f"{path}: open, but silent", SILENT_PORT_RETRY_S)
            self._fault_log.check(counters, now_s)

    def _report_or_reject(self, reason: str, retry_s: float) -> None:
        """Report why no samples arrive. On a port that is not the preferred one, prefer other ports for ``retry_s``."""
        if self._discovery.is_preferred:
            self._report(reason)
        else:
            self._reject_device(reason, retry_s)

    async def _send_until_check(self) -> None:
        """Send due bytes until the next check, or until the port is lost."""
        for _ in range(SENDS_PER_CHECK):
            self._last_check_s = self._monotonic()
            self._send_due()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(SEND_INTERVAL_S):
                    await self._port.lost.wait()
                    return

    def _report(self, reason: str) -> None:
        """Set the reason why no samples arrive, and log it if it is new since the last samples."""
        self._last_check_s = self._monotonic()
        self._silence_log.report(reason, self._last_check_s)
        self._silence_reason, self._rejected = reason, False
