"""Check that the board on the port is the pack's.

The pack's board is the configured one, otherwise the stored one, otherwise the first board of this run.

Another board has another voltage divider. Its voltages would be wrong by several percent without any other symptom.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from threading import Thread

import structlog

from bms_estimator.protocols.base.reading_protocol import DeviceProtocol
from bms_estimator.sources.serial.port_list import NO_BOARD, STORED_FIELDS, KnownBoardFile
from bms_estimator.sources.source import Chunk

MAX_PENDING_READS = 4096
"""Maximum number of pending chunks of a board whose serial number is still unknown. They hold at least several seconds of data."""
STORE_RETRY_S = 60.0
"""Minimum interval between two attempts to store the board [s]."""

log = structlog.get_logger(__name__)


class OtherBoardError(Exception):
    """The serial number of the board on the port differs from that of the pack's board."""


class BoardCheck:
    """Filter that passes the chunks of one board. Chunks of a reopened port wait until the serial number is known.

    Args:
        make_decoder: Creates a decoder for pending chunks.
        serial: Configured serial number. If it is empty, the number of the stored board counts, and without a stored
            board the number of the first board.
        board_file: File that stores the pack's board; None: the board is not stored.
    """

    def __init__(
        self, make_decoder: Callable[[], DeviceProtocol], serial: str = "", board_file: KnownBoardFile | None = None
    ) -> None:
        self._make_decoder, self._configured, self._board_file = make_decoder, serial, board_file
        self._known: Mapping[str, str] = board_file.load() if board_file else {}
        self._stored = self._known  # content of the file
        self._logged_without_serial = self._is_reloading = self._is_storing = self._store_failed = self._is_rejected = (
            False
        )
        self._store_attempt_s = -math.inf
        self.pending_protocol: DeviceProtocol | None = None
        """Decoder of the pending chunks; None if no chunks are pending."""
        self.on_recalibrated: Callable[[str], object] = lambda _: None
        """Called with the changes when the pack's board reports another calibration, before it is stored. The firmware
        replaces a damaged calibration by a default one."""
        self.is_zero_commanded = False
        """True while a command changes the zero of the current, so that its change is not reported."""
        self._pending = deque[Chunk]()
        self.rejected_bytes = 0
        """Number of bytes of other boards, of ports that were lost before their board was known, and of surplus pending chunks."""

    @property
    def serial(self) -> str:
        """Serial number of the pack's board; empty if any board is accepted."""
        return self._configured or self._known.get("serial", "")

    def on_port_opened(self) -> None:
        """Reset after the port was opened. The board on the port is unknown again."""
        self.pending_protocol = self._make_decoder() if self.serial else None
        self._is_rejected = False
        self._drop(self._pending)
        self._pending.clear()

    def reload_known_board(self) -> None:
        """Start a thread that checks if a user has accepted another board. A missing file does not count as acceptance."""
        if self._board_file and not self._is_reloading:
            self._is_reloading = True
            Thread(target=self._reload, args=(self._board_file,), daemon=True).start()

    def _reload(self, board_file: KnownBoardFile) -> None:
        """Read the file. It runs in its own thread, so that a hung disk does not block samples."""
        try:
            if board_file.load() == NO_BOARD:
                self._known = self._stored = NO_BOARD
        finally:
            self._is_reloading = False

    def accept(self, chunk: Chunk, decoder: DeviceProtocol) -> Sequence[Chunk]:
        """Return the chunks to decode now: none while the board is unknown, then all pending ones.

        Raises:
            OtherBoardError: The chunk is from another board. Later chunks are dropped until the port is reopened.
        """
        if self._is_rejected:
            self._drop((chunk,))
            return ()
        if self.pending_protocol is None:  # the board may have been exchanged on the open port
            if self.serial and (new_serial := decoder.serial_number_in(chunk[1])) is not None:
                self._check(new_serial, (chunk,))
            return (chunk,)
        if len(self._pending) == MAX_PENDING_READS:
            self._drop((self._pending.popleft(),))
        self._pending.append(chunk)
        self.pending_protocol.feed(*chunk)
        if not self.pending_protocol.board:
            return ()
        pending = list(self._pending)
        self._pending.clear()
        self._check(self.pending_protocol.board.get("serial", ""), pending)
        self.pending_protocol = None
        return pending

    def remember_board(self, board: Mapping[str, str], now_s: float) -> None:
        """Store ``board`` as the pack's, and log changes.

        Args:
            board: Reported properties of the board.
            now_s: Monotonic clock [s].
        """
        if not board:
            return
        if not board.get("serial"):
            self._log_without_serial()
            return
        previous, self._known = self._known, {name: board.get(name, "") for name in STORED_FIELDS}
        if self._known != previous:
            is_recalibrated = self._log_new_board(previous)
            # a new calibration is stored later: a restart before its alarm is saved must detect the change again
            self._store_attempt_s = now_s if is_recalibrated else -math.inf
        self._store_board(now_s)

    def _log_new_board(self, previous: Mapping[str, str]) -> bool:
        """Log and report changes of the board. Return True if it is the same one with another calibration."""
        changes = {
            name: f"{previous[name]} to {self._known[name]}"
            for name in STORED_FIELDS
            if previous.get(name) and previous[name] != self._known[name]
        }
        if self.is_zero_commanded:
            changes.pop("current_zero", None)
        if not changes:
            log.info("this is the pack's board from now on", **self._known)
        elif "serial" in changes:
            log.warning("another board", **changes)
        else:
            log.warning("the board is calibrated differently", **changes)
            text = ", ".join(f"{name} {change}" for name, change in changes.items())
            self.on_recalibrated(f"the board is calibrated differently, so that its values may be wrong: {text}")
            return True
        return False

    def _store_board(self, now_s: float) -> None:
        """Start a thread that stores the board, unless one is running or the last attempt is less than ``STORE_RETRY_S`` ago."""
        if self._board_file is None or self._is_storing or now_s - self._store_attempt_s < STORE_RETRY_S:
            return
        self._is_storing, self._store_attempt_s = True, now_s
        Thread(target=self._store, args=(self._board_file, self._known), daemon=True).start()

    def _store(self, board_file: KnownBoardFile, board: Mapping[str, str]) -> None:
        """Store the board. It runs in its own thread, so that a hung disk does not block samples."""
        try:
            if board != self._stored or board_file.is_missing():
                board_file.save(board)
            self._stored, self._store_failed = board, False
        except OSError as error:
            if not self._store_failed:
                log.warning("the board cannot be stored yet", file=str(board_file.path), reason=str(error))
            self._store_failed = True
        finally:
            self._is_storing = False

    def _drop(self, chunks: Iterable[Chunk]) -> None:
        self.rejected_bytes += sum(len(data) for _, data in chunks)

    def _check(self, serial: str, chunks: Sequence[Chunk]) -> None:
        """Compare the serial number of the board that sent ``chunks`` with that of the pack's board.

        Raises:
            OtherBoardError: The serial numbers differ.
        """
        if serial == self.serial:
            return
        self._is_rejected = True
        self._drop(chunks)
        remedy = (
            "or set sensor.serial to its number"
            if self._configured
            else f"or, to use this board instead, run `{self._board_file.accept_command}` with the pack's settings file"
            if self._board_file
            else "or restart the service to use this board"
        )
        raise OtherBoardError(
            f"board {serial or 'without a serial number'} is not the pack's, {self.serial}: connect that one, {remedy}"
        )

    def _log_without_serial(self) -> None:
        if not self._logged_without_serial:
            self._logged_without_serial = True
            log.warning(
                "the board has no serial number, so that an exchange of boards would not be noticed",
                hint="set one with `bms-estimator board --serial`",
            )
