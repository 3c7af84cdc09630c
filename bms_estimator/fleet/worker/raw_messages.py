"""Messages of one partition in the stream ``RAW``."""

from collections.abc import AsyncGenerator
from contextlib import aclosing

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.fits.messages import is_fit
from bms_estimator.fleet.nats.stored_messages import read_messages
from bms_estimator.fleet.nats.stream_reader import StoredMessage
from bms_estimator.fleet.packs.table_change import is_change


def is_block(data: bytes) -> bool:
    """Return True if a message of the stream is neither a change of the table nor a fit."""
    return not (is_change(data) or is_fit(data))


def trusted_data(subject: str, data: bytes) -> bytes:
    """Return the data of a stored message, or empty data if an edge has sent anything else in place of a block.

    Only workers send changes of the table, and only ``fleet fit`` sends fits. Empty data are rejected as a damaged block.

    Args:
        subject: Subject under which the stream ``RAW`` stores the message.
        data: Data of the message.
    """
    return b"" if subjects.is_raw(subject) and not is_block(data) else data


class RawMessages:
    """Reader of the messages of one partition. All methods raise ``nats.errors.Error`` if the server does not respond.

    Args:
        nc: Connection to the tenant's NATS account.
        partition: Number of the partition.
    """

    def __init__(self, nc: Client, partition: int) -> None:
        self._nc, self._js = nc, nc.jetstream()
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

    async def has_later(self, sequence: int) -> bool:
        """Return True if the partition has a message with a larger stream sequence number."""
        try:
            await self._js.get_msg(subjects.RAW_STREAM, sequence + 1, self._subject, next=True)
        except NotFoundError:
            return False
        return True

    async def read(self, first: int, last: int) -> AsyncGenerator[tuple[str, StoredMessage], None]:
        """Yield the messages in the order of the stream, each with the name of its pack.

        Args:
            first: Stream sequence number at which the reading begins.
            last: Stream sequence number up to which messages are read.
        """
        async with aclosing(read_messages(self._nc, subjects.RAW_STREAM, self._subject, first, last)) as messages:
            async for message in messages:
                pack = message.subject.rpartition(".")[2]
                yield pack, message._replace(data=trusted_data(message.subject, message.data))
