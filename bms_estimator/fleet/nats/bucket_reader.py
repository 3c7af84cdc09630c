"""Readers of a key-value bucket: of all values, and of the changes by polling."""

from collections.abc import Callable

import nats.errors
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.nats.stream_reader import StoredMessage, StreamError, read_stream

_REMOVING_OPERATIONS = frozenset({"DEL", "PURGE"})


class BucketReader:
    """Reader of a bucket; each call of ``read`` continues where the previous one ended.

    Args:
        nc: Connection to the tenant's NATS account.
        bucket: Name of the bucket.

    Attributes:
        lost: Keys of an earlier bucket of this name, which the present bucket lacks because the server has lost data.
    """

    def __init__(self, nc: Client, bucket: str) -> None:
        self._nc, self._bucket = nc, bucket
        self._next_sequence = 1
        self._created: object = None  # creation time of the read stream
        self._keys = set[str]()  # also removed keys, which have a deletion marker
        self.lost = set[str]()

    async def read(self, set_value: Callable[[str, bytes | None], object]) -> None:
        """Call ``set_value`` with each changed key and its value; None: the key was removed.

        If the bucket has fewer keys than were read, because an erasure has purged some (``purge_keys``), all of it is read again.

        Raises:
            StreamError: The server does not respond, or has no such bucket.
        """
        try:
            info = await self._nc.jetstream().stream_info(stream_of(self._bucket))
        except nats.errors.Error as error:
            raise StreamError(f"the server rejects reading {stream_of(self._bucket)}: {error_text(error)}") from None
        # a new bucket of the same name numbers its messages from 1 again
        is_new_bucket = info.created != self._created or info.state.last_seq + 1 < self._next_sequence
        is_purged = not is_new_bucket and info.state.messages < len(self._keys)
        first = 1 if is_new_bucket or is_purged else self._next_sequence
        read_keys, last = set[str](), first - 1
        async for batch in read_stream(self._nc, stream_of(self._bucket), subject_of(self._bucket, ">"), first=first):
            for message in batch:
                key, data = parse_entry(self._bucket, message)
                read_keys.add(key)
                set_value(key, data)
            last = batch[-1].sequence
        for key in self._keys - read_keys if is_purged else ():
            set_value(key, None)
        self.lost = (self.lost | self._keys if is_new_bucket else self.lost) - read_keys
        self._keys = read_keys if first == 1 else self._keys | read_keys
        self._next_sequence, self._created = last + 1, info.created


async def read_bucket(nc: Client, bucket: str) -> dict[str, bytes]:
    """Return all values of a bucket by key.

    Raises:
        StreamError: The server does not respond, or has no such bucket.
    """
    values = dict[str, bytes]()
    async for batch in read_stream(nc, stream_of(bucket), subject_of(bucket, ">")):
        for message in batch:
            key, data = parse_entry(bucket, message)
            if data is None:
                values.pop(key, None)
            else:
                values[key] = data
    return values


def parse_entry(bucket: str, message: StoredMessage) -> tuple[str, bytes | None]:
    """Return key and value of a message; the value None means that the key was removed."""
    is_removed = message.headers.get("KV-Operation") in _REMOVING_OPERATIONS or "Nats-Marker-Reason" in message.headers
    return message.subject.removeprefix(subject_of(bucket, "")), None if is_removed else message.data


def stream_of(bucket: str) -> str:
    """Return the name of a bucket's stream."""
    return f"KV_{bucket}"


def subject_of(bucket: str, key: str) -> str:
    """Return the subject of a key."""
    return f"$KV.{bucket}.{key}"
