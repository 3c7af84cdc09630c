"""Messages of a partition in the stream ``RAW``, and reader of the stream."""

from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import NamedTuple

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.fits.messages import is_fit
from bms_estimator.fleet.nats.stored_messages import read_messages
from bms_estimator.fleet.packs.table_change import is_change


def is_block(data: bytes) -> bool:
    """Return True if a message of the stream is neither a change of the table nor a fit."""
    return not (is_change(data) or is_fit(data))


class RawMessage(NamedTuple):
    """Message of a partition."""

    pack: str
    data: bytes
    """Empty if an edge has sent anything else in place of a block. Only workers send changes of the table, and only
    ``fleet fit`` sends fits. Empty data are rejected as a damaged block."""
    sequence: int
    """Sequence number in the stream."""
    received_s: int | None
    """Server's clock at the arrival of the message [s since 1970]; None: unknown."""


def raw_message(subject: str, data: bytes, sequence: int, received_s: int | None) -> RawMessage:
    """Return a message that the stream ``RAW`` stores under a subject."""
    is_forged = subjects.is_raw(subject) and not is_block(data)
    return RawMessage(subject.rpartition(".")[2], b"" if is_forged else data, sequence, received_s)


class PartitionReader:
    """Reader of the messages of one partition. All methods raise ``nats.errors.Error`` if the server does not respond.

    Args:
        nc: Connection to the tenant's NATS account.
        partition: Number of the partition.
    """

    def __init__(self, nc: Client, partition: int) -> None:
        self._nc, self._js, self._partition = nc, nc.jetstream(), partition
        self._subject = subjects.stored(partition)

    async def last_sequence(self) -> int:
        """Return the stream sequence number of the last message of the partition; 0 without a message."""
        try:
            return (await self._js.get_last_msg(subjects.RAW_STREAM, self._subject)).seq or 0
        except NotFoundError:
            return 0

    async def last_of_all_partitions(self) -> int:
        """Return the stream sequence number of the last message of all partitions."""
        return (await self._js.stream_info(subjects.RAW_STREAM)).state.last_seq

    async def next(self, first: int, pack: str = "*") -> RawMessage | None:
        """Return the first message from a stream sequence number on; None without one.

        Args:
            first: Stream sequence number.
            pack: Name of the pack whose messages are searched; default: all packs.
        """
        subject = subjects.stored(self._partition, pack)
        try:
            found = await self._js.get_msg(subjects.RAW_STREAM, first, subject, next=True)
        except NotFoundError:
            return None
        received_s = int(found.time.timestamp()) if found.time else None
        return raw_message(found.subject or "", found.data or b"", found.seq or 0, received_s)

    async def read(self, first: int, last: int) -> AsyncGenerator[RawMessage, None]:
        """Yield the messages in the order of the stream.

        Args:
            first: Stream sequence number at which the reading begins.
            last: Stream sequence number up to which messages are read.
        """
        async with aclosing(read_messages(self._nc, subjects.RAW_STREAM, self._subject, first, last)) as messages:
            async for message in messages:
                yield raw_message(message.subject, message.data, message.sequence, message.received_s)
