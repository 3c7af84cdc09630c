"""Return of partitions to their checkpoint of an earlier day, for example after wrong samples have spoiled learned values."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from datetime import UTC, date, datetime
from functools import partial

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, Pointer, pointer_key
from bms_estimator.fleet.nats.streams import require_partitions
from bms_estimator.fleet.packs.pack_bucket import read_bucket
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import read_checkpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore, open_checkpoints
from bms_estimator.fleet.worker.checkpoint.claims import change_checkpoints
from bms_estimator.fleet.worker.checkpoint.format_versions import CheckpointError
from bms_estimator.model.errors import UserError

WORKER_NAME = "checkpoints-restore"
"""Name with which the command claims a partition."""


def day_of(info: CheckpointInfo) -> date:
    """Return the UTC day on which a checkpoint was written."""
    return datetime.fromtimestamp(info.made_s, UTC).date()


async def read_pointers(nc: Client) -> dict[int, Pointer]:
    """Return the pointers to the checkpoints, by partition.

    Raises:
        UserError: The server has no streams.
    """
    partitions = await require_partitions(nc)
    entries = await read_bucket(nc, subjects.CHECKPOINTS_BUCKET)
    keys = {number: pointer_key(number) for number in range(partitions)}
    return {number: Pointer.model_validate_json(entries[key]) for number, key in keys.items() if key in entries}


async def restore_day(
    nc: Client, day: date, partitions: Collection[int], *, skip_blocks: bool
) -> Mapping[int, CheckpointInfo]:
    """Make the daily checkpoint of a day the last checkpoint of each partition.

    Args:
        nc: Connection to the tenant's NATS account.
        day: UTC day.
        partitions: Numbers of the partitions; empty: all.
        skip_blocks: Skip all blocks that are in the stream now. Otherwise the workers process those after the checkpoint again.

    Returns:
        The daily checkpoints, by partition. Partitions without a checkpoint of the day remain unchanged, and are left out.

    Raises:
        UserError: No partition has a checkpoint of the day, or one is damaged or of a version that this one cannot read.
    """
    pointers = await read_pointers(nc)
    chosen = {
        number: info
        for number, pointer in pointers.items()
        for info in pointer.daily
        if day_of(info) == day and (not partitions or number in partitions)
    }
    if not chosen:
        days = sorted({day_of(info) for pointer in pointers.values() for info in pointer.daily})
        raise UserError(f"{day}: no checkpoint of this day; there are those of {', '.join(map(str, days)) or 'no day'}")
    store = await open_checkpoints(nc, WORKER_NAME)
    last = (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.last_seq if skip_blocks else None
    for number, info in chosen.items():
        await change_checkpoints(nc, number, partial(_restore, store, number, info, last))
    return chosen


async def _restore(store: CheckpointStore, number: int, info: CheckpointInfo, last_sequence: int | None) -> None:
    """Make a daily checkpoint the last checkpoint of a partition.

    Args:
        store: Checkpoints.
        number: Number of the partition.
        info: Daily checkpoint.
        last_sequence: Stream sequence number of the last skipped message; None: no message is skipped.

    Raises:
        UserError: The checkpoint cannot be read.
        FencedError: A worker has claimed the partition meanwhile.
    """
    try:
        claim = await store.claim(number)
        checkpoint = read_checkpoint(await store.read(info))
    except CheckpointError as error:
        raise UserError(f"partition {number}: {error}") from None
    if last_sequence is not None:
        checkpoint = replace(checkpoint, sequence=last_sequence, deferred={})
    # all live workers read the format of the last checkpoint
    await store.replace_last(claim, checkpoint, file_format=claim.pointer.kept[0].format)
