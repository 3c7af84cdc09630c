"""Dead letters: blocks that workers could not process, and rejected batches of telemetry, with the reason.

They are stored in the stream ``DEAD``. The subject of a dead letter contains the pack and the digest of the block or batch. Therefore
a block that is sent again replaces its earlier dead letter.
"""

import hashlib
from typing import NamedTuple, Self

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_reader import StoredMessage, read_stream

REASON_HEADER, SEQUENCE_HEADER, WORKER_HEADER = "Bms-Reason", "Bms-Sequence", "Bms-Worker"
SUBJECT_HEADER = "Bms-Subject"
TIME_HEADER = "Nats-Time-Stamp"
"""Header of the server with the time of storage (RFC 3339)."""
DIGEST_BYTES = 8
"""Size of the digest of a block in its subject [bytes]."""
MAX_REASON_CHARACTERS = 1000
"""Maximum length of a reason. A longer one is truncated."""


class DeadLetter(NamedTuple):
    """Block that a worker could not process, or batch of telemetry that was rejected."""

    pack: str
    sequence: int
    """Sequence number of the block in the stream ``RAW``, or of the batch in ``TELEMETRY``."""
    reason: str
    worker: str
    """Name of the worker that stored the dead letter; ``ingest`` for a batch."""
    data: bytes
    """Bytes of the block or batch."""
    batch_subject: str = ""
    """Subject of a rejected batch of telemetry; empty for a block."""
    time: str = ""
    """Time of storage (RFC 3339), set by the server."""
    stored_sequence: int = 0
    """Sequence number of the dead letter in the stream ``DEAD``, set by the server."""

    @property
    def subject(self) -> str:
        """Subject in the stream ``DEAD``."""
        return subjects.dead(self.pack, hashlib.blake2b(self.data, digest_size=DIGEST_BYTES).hexdigest())

    def headers(self) -> dict[str, str]:
        """Return the headers of the stored message."""
        reason = one_line(self.reason)
        subject = {SUBJECT_HEADER: self.batch_subject} if self.batch_subject else {}
        return {REASON_HEADER: reason, SEQUENCE_HEADER: str(self.sequence), WORKER_HEADER: self.worker} | subject

    @classmethod
    def of(cls, message: StoredMessage) -> Self:
        """Return the dead letter in a stored message."""
        headers = message.headers
        return cls(
            pack=message.subject.split(".")[1],
            sequence=int(headers.get(SEQUENCE_HEADER, 0)),
            reason=headers.get(REASON_HEADER, ""),
            worker=headers.get(WORKER_HEADER, ""),
            data=message.data,
            batch_subject=headers.get(SUBJECT_HEADER, ""),
            time=headers.get(TIME_HEADER, ""),
            stored_sequence=message.sequence,
        )


def one_line(reason: str) -> str:
    """Return a reason as one line that can be encoded. Its parts may come from a batch or block, and contain any characters."""
    text = reason[:MAX_REASON_CHARACTERS].replace("\r", " ").replace("\n", " ")
    return text.encode(errors="backslashreplace").decode()


async def read_dead_letters(nc: Client) -> list[DeadLetter]:
    """Return all dead letters in the order of their blocks in the stream ``RAW``.

    Raises:
        StreamError: The server does not respond, or has no such stream.
    """
    letters = list[DeadLetter]()
    async for batch in read_stream(nc, subjects.DEAD_STREAM, subjects.dead()):
        letters += map(DeadLetter.of, batch)
    return sorted(letters, key=lambda letter: letter.sequence)


async def replay_letter(nc: Client, letter: DeadLetter) -> None:
    """Send the block of a dead letter to the workers again, and remove the dead letter.

    If a worker rejects the block again before the removal, the new dead letter remains.

    Raises:
        nats.errors.Error: The server does not accept the block; the dead letter remains stored.
    """
    js = nc.jetstream()
    await js.publish(letter.batch_subject or subjects.raw(letter.pack), letter.data)
    await js.purge_stream(subjects.DEAD_STREAM, subject=letter.subject, seq=letter.stored_sequence + 1)
