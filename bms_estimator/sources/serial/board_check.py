"""Check that the board on the line is the pack's: the configured or stored one, or the first one of this run.

Another board has another divider: its voltages would be wrong by several percent, without any other sign.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from threading import Thread

import structlog

from bms_estimator.protocols.base.device_protocol import DeviceProtocol
from bms_estimator.sources.serial.known_board_file import NO_BOARD, REMEMBERED, KnownBoardFile
from bms_estimator.sources.source import Chunk

MAX_PENDING_READS = 4096
"""Maximum number of chunks stored for a board without a serial number yet: seconds at any rate."""

RETRY_S = 60.0
"""Interval at which a board that could not be stored is written again [s]."""

log = structlog.get_logger(__name__)


class OtherBoardError(Exception):
    """The board's serial number is not that of the pack's."""


class BoardCheck:
    """Lets the reads of one board pass; those of a reopened port wait until its serial number is known.

    Args:
        make: Creates a decoder for pending chunks.
        serial: Serial number of the pack's board, as the settings have it; empty: the stored one, otherwise that of the first
            board.
        memory: What outlives a restart; None: nothing does.
    """

    def __init__(
        self, make: Callable[[], DeviceProtocol], serial: str = "", memory: KnownBoardFile | None = None
    ) -> None:
        self._make, self._told, self._memory = make, serial, memory
        self._known: Mapping[str, str] = memory.load() if memory else {}
        self._kept = self._known  # on disk
        self._nameless = self._looking = self._keeping = self._failed = self._refused = False
        self._tried_s = -math.inf
        self.pending_protocol: DeviceProtocol | None = None
        """Decoder of a pending board."""
        self._held = deque[Chunk]()
        self.unadmitted_bytes = 0
        """Bytes of refused boards, of ports lost before their board was known, and of chunks beyond the limit."""

    @property
    def serial(self) -> str:
        """Serial number of the pack's board; empty if any board is accepted."""
        return self._told or self._known.get("serial", "")

    def opened(self) -> None:
        """Reset after the port was opened again."""
        self.pending_protocol = self._make() if self.serial else None
        self._refused = False
        self._drop(self._held)
        self._held.clear()

    def reload_known_board(self) -> None:
        """Check soon whether another board was accepted. A missing file does not mean that."""
        if self._memory and not self._looking:
            self._looking = True
            Thread(target=self._look, args=(self._memory,), daemon=True).start()

    def _look(self, memory: KnownBoardFile) -> None:
        """Check for another board in a thread of its own, so that a hung disk blocks nothing."""
        try:
            if memory.load() == NO_BOARD:
                self._known = self._kept = NO_BOARD
        finally:
            self._looking = False

    def accept(self, read: Chunk, decoder: DeviceProtocol) -> Sequence[Chunk]:
        """Return the chunks of the pack's board for ``decoder``.

        Raises:
            OtherBoardError: Neither this one nor those after it, until the port is reopened.
        """
        if self._refused:
            self._drop((read,))
            return ()
        if self.pending_protocol is None:
            if self.serial and (swapped := decoder.serial_number_in(read[1])) is not None:
                self._check(swapped, (read,))
            return (read,)
        if len(self._held) == MAX_PENDING_READS:
            self._drop((self._held.popleft(),))
        self._held.append(read)
        self.pending_protocol.feed(*read)
        if not self.pending_protocol.board:
            return ()
        held = list(self._held)
        self._held.clear()
        self._check(self.pending_protocol.board.get("serial", ""), held)
        self.pending_protocol = None
        return held

    def remember_board(self, board: Mapping[str, str], now_s: float) -> None:
        """Accept samples of ``board`` as the pack's from now on; log and store what changed.

        Args:
            board: Reported properties of the board.
            now_s: Monotonic clock [s].
        """
        if not board:
            return
        if not board.get("serial"):
            self._log_without_serial()
            return
        before, self._known = self._known, {name: board.get(name, "") for name in REMEMBERED}
        if self._known != before:
            self._log_new_board(before)
            self._tried_s = -math.inf
        self._remember(now_s)

    def _log_new_board(self, before: Mapping[str, str]) -> None:
        changes = [name for name in REMEMBERED if before.get(name) and before[name] != self._known[name]]
        if changes:
            changed = {name: f"{before[name]} to {self._known[name]}" for name in changes}
            log.warning(
                "the board is calibrated differently" if "serial" not in changes else "another board", **changed
            )
        else:
            log.info("this is the pack's board from now on", **self._known)

    def _remember(self, now_s: float) -> None:
        """Store the board without blocking on a hung disk; retry a failed write while samples arrive."""
        if self._memory is None or self._keeping or now_s - self._tried_s < RETRY_S:
            return
        self._keeping, self._tried_s = True, now_s
        Thread(target=self._store, args=(self._memory, self._known), daemon=True).start()

    def _store(self, memory: KnownBoardFile, board: Mapping[str, str]) -> None:
        """Store the board in a thread of its own."""
        try:
            if board != self._kept or memory.is_gone():
                memory.save(board)
            self._kept, self._failed = board, False
        except OSError as error:
            if not self._failed:
                log.warning("the board cannot be remembered yet", file=str(memory.path), reason=str(error))
            self._failed = True
        finally:
            self._keeping = False

    def _drop(self, reads: Iterable[Chunk]) -> None:
        self.unadmitted_bytes += sum(len(data) for _, data in reads)

    def _check(self, found: str, reads: Sequence[Chunk]) -> None:
        """Let the board that has sent ``reads`` in.

        Raises:
            OtherBoardError: It is another.
        """
        if found == self.serial:
            return
        self._refused = True
        self._drop(reads)
        accept = (
            "or set sensor.serial to its number"
            if self._told
            else f"or, if it takes its place, run `{self._memory.how_to_forget}` with the pack's settings file"
            if self._memory
            else "or start anew"
        )
        raise OtherBoardError(
            f"board {found or 'without a serial number'} is not the pack's, {self.serial}: plug that in, {accept}"
        )

    def _log_without_serial(self) -> None:
        if not self._nameless:
            self._nameless = True
            log.warning(
                "the board has no serial number: another in its place would not be noticed",
                hint="give it one with `bms-estimator board --serial`",
            )
