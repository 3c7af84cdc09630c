"""Formats of checkpoints that this version reads and writes.

A version reads and writes two successive formats. A worker writes the newest format that all live workers read, so that workers
of two versions can take over partitions from each other. A reader of any other format raises ``UnreadableFormatError``, and the
worker then leaves the partition to others.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

Header = dict[str, Any]


class HeaderMigration(NamedTuple):
    """Conversions of a header between two successive formats. Entries need none, because layouts name their fields."""

    upgrade: Callable[[Header], Header]
    """Return a header of the older format as one of the newer format."""
    downgrade: Callable[[Header], Header]
    """Return a header of the newer format as one of the older format."""


FORMAT = 3
"""Newest format that this version reads and writes. Format 3 added increments."""
INCREMENT_FORMAT = 3
"""First format with increments."""


class CheckpointError(ValueError):
    """Unreadable checkpoint; the message gives the reason and a remedy."""


def _without_increments(header: Header) -> Header:
    """Return a header of format 3 as one of format 2."""
    return {name: value for name, value in header.items() if name != "increment"}


def _with_increments(header: Header) -> Header:
    """Return a header of format 2 as one of format 3.

    Raises:
        CheckpointError: The header is not of format 2.
    """
    if "increment" in header:
        raise CheckpointError("the checkpoint is damaged: its format is not the one of its header")
    return header | {"increment": 0}


PREVIOUS: HeaderMigration | None = HeaderMigration(upgrade=_with_increments, downgrade=_without_increments)
"""Migration between format ``FORMAT - 1`` and ``FORMAT``; None while ``FORMAT`` is the first format."""


class UnreadableFormatError(CheckpointError):
    """Error of an intact checkpoint in a format that this version cannot read.

    Args:
        found: Format of the checkpoint; 0 if even the metadata of the checkpoint is unreadable.
    """

    def __init__(self, found: int) -> None:
        what = f"the checkpoint is of format {found}" if found else "the pointer to the checkpoints is unreadable"
        super().__init__(f"{what}, this version reads {readable_text()}: start a worker of the version that wrote it")
        self.found = found


def oldest_format() -> int:
    """Return the oldest format that this version reads and writes."""
    return FORMAT if PREVIOUS is None else FORMAT - 1


def readable_text() -> str:
    """Return the readable formats as text, such as ``1 and 2``."""
    return f"{FORMAT}" if PREVIOUS is None else f"{FORMAT - 1} and {FORMAT}"


def is_readable(found: int) -> bool:
    """Return True if this version reads a format."""
    return oldest_format() <= found <= FORMAT


def common_format(newest_formats: Iterable[int]) -> int:
    """Return the format to write: the newest one that all workers read, as far as this version writes it.

    Args:
        newest_formats: Newest format that each other worker reads.
    """
    return max(oldest_format(), min([FORMAT, *newest_formats]))


def upgrade(header: Header, file_format: int) -> Header:
    """Return a header of a readable format as one of ``FORMAT``."""
    return PREVIOUS.upgrade(header) if PREVIOUS and file_format < FORMAT else header


def downgrade(header: Header, file_format: int) -> Header:
    """Return a header of ``FORMAT`` as one of a format that this version writes."""
    return PREVIOUS.downgrade(header) if PREVIOUS and file_format < FORMAT else header
