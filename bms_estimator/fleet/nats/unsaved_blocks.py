"""Share of the stream ``RAW`` that consists of blocks in no checkpoint.

When it reaches 1, the stream drops blocks that no checkpoint includes, and the edges must send them again.
"""

import time
from collections.abc import Iterable
from typing import NamedTuple

from nats.aio.client import Client
from nats.js.api import RawStreamMsg
from nats.js.client import JetStreamContext
from nats.js.errors import NotFoundError
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer, pointer_key

WARNING_SHARE = 0.5
"""Share above which a warning is logged and shown."""
MIN_BLOCK_S = 1.0
"""Minimum duration of a block [s]. A pack reaches its limit of N stored blocks after N times this duration at the earliest."""
MAX_CHECKED_PACKS = 3
"""Number of packs that are checked in each partition: those with the most stored blocks."""


class UnsavedShare(NamedTuple):
    """Share of the stream that no checkpoint includes."""

    share: float = 0.0
    """Largest share by size, by age, or of the blocks that the stream stores of one pack; 0 to 1."""
    pack: str = ""
    """Pack whose number of blocks has this share; empty for a share by size or age."""
    max_blocks: int = 0
    """Maximum number of stored blocks of a pack."""

    @property
    def warning(self) -> str:
        """Warning if more than half is unsaved; otherwise an empty text."""
        if self.share <= WARNING_SHARE:
            return ""
        if not self.pack:
            return (
                f"{self.share:.0%} of the stream {subjects.RAW_STREAM} are blocks that no checkpoint includes: "
                "start workers, or increase packs or outage_days of the server"
            )
        limit = f"the stream {subjects.RAW_STREAM}, which stores {self.max_blocks} blocks of a pack"
        if self.share >= 1.0:
            text = f"{limit}, has dropped blocks of {self.pack} that no checkpoint includes"
        else:
            text = f"{self.share:.0%} of the blocks of {self.pack} in {limit}, are in no checkpoint"
        return f"{text}: start workers, and set block_s of the server to the block_s of the edges"


async def unsaved_blocks(nc: Client, partitions: Iterable[int]) -> UnsavedShare:
    """Return the largest share of the stream, by size, age or number, that no checkpoint includes.

    Sizes are computed from the mean size of all messages.

    Args:
        nc: Connection to the tenant's NATS account.
        partitions: Numbers of the partitions whose checkpoints are considered.

    Raises:
        StreamError: The bucket cannot be read.
        nats.errors.Error: The stream cannot be read.
    """
    js, now_s = nc.jetstream(), time.time()
    raw = await js.stream_info(subjects.RAW_STREAM)
    pointers = await read_bucket(nc, subjects.CHECKPOINTS_BUCKET)
    max_blocks = max(raw.config.max_msgs_per_subject or 0, 0)
    oldest_sequence, oldest_s, max_of_packs = raw.state.last_seq + 1, now_s, UnsavedShare()
    for partition in partitions:
        first = _saved_sequence(pointers.get(pointer_key(partition))) + 1
        message = await _message(js, subjects.stored(partition), first)
        if message is None:
            continue
        oldest_s = min(oldest_s, _time_s(message, now_s))
        oldest_sequence = min(oldest_sequence, message.seq or oldest_sequence)
        if max_blocks and now_s - _time_s(message, now_s) > WARNING_SHARE * MIN_BLOCK_S * max_blocks:
            max_of_packs = max(max_of_packs, await _unsaved_of_packs(js, partition, first, max_blocks))
    mean_bytes = raw.state.bytes / max(1, raw.state.messages)
    unsaved_bytes = mean_bytes * (raw.state.last_seq + 1 - oldest_sequence)
    max_bytes, max_age_s = raw.config.max_bytes or 0, raw.config.max_age or 0.0
    by_size = unsaved_bytes / max_bytes if max_bytes > 0 else 0.0
    by_age = (now_s - oldest_s) / max_age_s if max_age_s > 0.0 else 0.0
    return max(UnsavedShare(min(1.0, max(by_size, by_age))), max_of_packs)  # compared by their shares


async def _unsaved_of_packs(js: JetStreamContext, partition: int, first: int, max_blocks: int) -> UnsavedShare:
    """Return the largest unsaved share of a pack's limit in a partition.

    The number of unsaved blocks is estimated from the part of the stored time span that they cover.

    Args:
        js: JetStream of the tenant.
        partition: Number of the partition.
        first: First stream sequence number after the checkpoint.
        max_blocks: Maximum number of stored blocks of a pack.
    """
    info = await js.stream_info(subjects.RAW_STREAM, subjects_filter=subjects.stored_raw(partition))
    counts = sorted((info.state.subjects or {}).items(), key=lambda each: -each[1])
    result, now_s = UnsavedShare(), time.time()
    for subject, count in counts[:MAX_CHECKED_PACKS]:
        oldest, unsaved = await _message(js, subject, 1), await _message(js, subject, first)
        if oldest and unsaved:
            begin_s = _time_s(oldest, now_s)
            part = (now_s - _time_s(unsaved, now_s)) / (now_s - begin_s) if now_s > begin_s else 0.0
            share = min(1.0, part * count / max_blocks)
            result = max(result, UnsavedShare(share, subject.rpartition(".")[2], max_blocks))
    return result


async def _message(js: JetStreamContext, subject: str, first: int) -> RawStreamMsg | None:
    """Return the first stored message of a subject from a sequence number on; None without one."""
    try:
        return await js.get_msg(subjects.RAW_STREAM, first, subject=subject, next=True)
    except NotFoundError:
        return None


def _time_s(message: RawStreamMsg, now_s: float) -> float:
    """Return the time of a message's arrival [s since 1970]; the present time without one."""
    return now_s if message.time is None else message.time.timestamp()


def _saved_sequence(pointer: bytes | None) -> int:
    """Return the sequence number of the last message in a partition's last checkpoint; 0 without a checkpoint."""
    try:
        kept = CheckpointPointer.model_validate_json(pointer or b"").kept
    except ValidationError:
        return 0
    return kept[0].sequence if kept else 0
