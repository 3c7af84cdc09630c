"""Choice between a whole checkpoint and an increment, which contains only the packs that were changed since the last save.

If all packs send blocks between two saves, each checkpoint is whole. If few do, the size of a save is nearly proportional to
their number.
"""

from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, Pointer
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import PartitionCheckpoint
from bms_estimator.fleet.worker.checkpoint.format_versions import INCREMENT_FORMAT

MAX_INCREMENTS = 32
"""Maximum number of increments of a checkpoint, which limits the number of objects."""
MAX_INCREMENT_FRACTION = 0.5
"""Maximum total size of the increments of a checkpoint, as a fraction of the size of the whole checkpoint before them."""
DAY_S = 86_400
"""Duration of a day [s]."""


def next_increment(
    checkpoint: PartitionCheckpoint, pointer: Pointer, *, file_format: int, now_s: float
) -> PartitionCheckpoint | None:
    """Return the increment to write after the last checkpoint; None if a whole checkpoint must be written.

    Args:
        checkpoint: Whole checkpoint of the partition.
        pointer: Pointer to the stored checkpoints.
        file_format: Format in which the checkpoint is written.
        now_s: Wall clock [s since 1970].
    """
    if checkpoint.changed is None or file_format < INCREMENT_FORMAT or not pointer.kept:
        return None
    last = pointer.kept[0]
    if last.format != file_format or len(last.increments) >= MAX_INCREMENTS or not has_daily(pointer.daily, now_s):
        return None
    increment = checkpoint.to_increment(len(last.increments) + 1)
    size = last.increment_bytes + sum(map(len, increment.packs.values()))
    return increment if size <= MAX_INCREMENT_FRACTION * last.bytes else None


def with_increment(pointer: Pointer, sequence: int, size: int, now_s: float) -> Pointer:
    """Return a pointer with the next object as an increment of the last checkpoint.

    Args:
        pointer: Present pointer.
        sequence: Stream sequence number of the last message that the increment includes.
        size: Size of the increment [bytes].
        now_s: Wall clock [s since 1970].
    """
    last, *earlier = pointer.kept
    update = {
        "sequence": sequence,
        "made_s": now_s,
        "increments": (*last.increments, pointer.next),
        "increment_bytes": last.increment_bytes + size,
    }
    return Pointer(kept=(last.model_copy(update=update), *earlier), daily=pointer.daily)


def has_daily(daily: tuple[CheckpointInfo, ...], now_s: float) -> bool:
    """Return True if a checkpoint of the present UTC day is among the daily ones."""
    return any(each.made_s // DAY_S == now_s // DAY_S for each in daily)
