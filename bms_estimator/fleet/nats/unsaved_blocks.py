"""Share of the stream ``RAW`` that is filled by blocks after the last checkpoints of the partitions.

When it reaches 1, the stream drops blocks that no checkpoint includes, and the edges must send them again.
"""

import time
from collections.abc import Iterable

from nats.aio.client import Client
from nats.js.errors import KeyNotFoundError, NotFoundError
from nats.js.kv import KeyValue
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import Pointer, pointer_key

WARNING_SHARE = 0.5
"""Share above which operators are warned."""


async def unsaved_share(nc: Client, partitions: Iterable[int]) -> float:
    """Return the part of the stream from the first block after a checkpoint on, by size or age, whichever is larger.

    Args:
        nc: Connection to the tenant's NATS account.
        partitions: Numbers of the partitions whose checkpoints are considered.

    Returns:
        The share, 0 to 1. The size is computed with the mean size of all messages.

    Raises:
        nats.errors.Error: The stream or the bucket cannot be read.
    """
    js = nc.jetstream()
    raw = await js.stream_info(subjects.RAW_STREAM)
    bucket = await js.key_value(subjects.CHECKPOINTS_BUCKET)
    oldest_sequence, oldest_s = raw.state.last_seq + 1, time.time()
    for partition in partitions:
        first = await _saved_sequence(bucket, partition) + 1
        try:
            message = await js.get_msg(subjects.RAW_STREAM, first, subject=subjects.stored(partition), next=True)
        except NotFoundError:
            continue
        if message.time is not None:
            oldest_s = min(oldest_s, message.time.timestamp())
        oldest_sequence = min(oldest_sequence, message.seq or oldest_sequence)
    mean_bytes = raw.state.bytes / max(1, raw.state.messages)
    unsaved_bytes = mean_bytes * (raw.state.last_seq + 1 - oldest_sequence)
    max_bytes, max_age_s = raw.config.max_bytes or 0, raw.config.max_age or 0.0
    by_size = unsaved_bytes / max_bytes if max_bytes > 0 else 0.0
    by_age = (time.time() - oldest_s) / max_age_s if max_age_s > 0.0 else 0.0
    return min(1.0, max(by_size, by_age))


def unsaved_warning(share: float) -> str:
    """Return a warning if more than half of the stream is unsaved; otherwise an empty text."""
    if share <= WARNING_SHARE:
        return ""
    return (
        f"{share:.0%} of the stream {subjects.RAW_STREAM} are blocks that no checkpoint includes: "
        "start workers, or increase packs or outage_days of the server"
    )


async def _saved_sequence(bucket: KeyValue, partition: int) -> int:
    """Return the sequence number of the last message in a partition's last checkpoint; 0 without a checkpoint."""
    try:
        pointer = Pointer.model_validate_json((await bucket.get(pointer_key(partition))).value or b"")
    except (KeyNotFoundError, ValidationError):
        return 0
    return pointer.kept[0].sequence if pointer.kept else 0
