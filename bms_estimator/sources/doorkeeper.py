"""Whether a board that was found is the one with which it began: under ``auto`` another may have been plugged in."""

from collections import deque
from collections.abc import Callable, Sequence

from bms_estimator.sources.dialects import Dialect
from bms_estimator.sources.line import Read

HELD_READS = 4096
"""So many reads are kept for a board that has not told its serial number yet: seconds at any rate."""


class OtherBoardError(Exception):
    """The board's serial number is not the one with which it began."""


class Doorkeeper:
    """Lets the reads of one board pass; those of a port opened anew wait until its serial number is known.

    Args:
        make: A dialect that hears them meanwhile.

    Attributes:
        serial: Of the board with which it began; empty: any board may come.
    """

    def __init__(self, make: Callable[[], Dialect]) -> None:
        self._make = make
        self.serial = ""
        self.stranger: Dialect | None = None
        """What hears a board that is not known yet."""
        self._held = deque[Read](maxlen=HELD_READS)

    def opened(self) -> None:
        """The port was opened anew."""
        self.stranger = self._make() if self.serial else None
        self._held.clear()

    def admit(self, read: Read) -> Sequence[Read]:
        """The reads that may pass now.

        Raises:
            OtherBoardError: None ever will.
        """
        if self.stranger is None:
            return (read,)
        self._held.append(read)
        self.stranger.feed(*read)
        found = self.stranger.board
        if not found:
            return ()
        if (other := found.get("serial", "")) != self.serial:
            raise OtherBoardError(
                f"board {other or 'without a serial number'} is not the one with which this began, {self.serial}: "
                "plug that in, or name the port in sensor.port and start anew"
            )
        self.stranger = None
        return list(self._held)
