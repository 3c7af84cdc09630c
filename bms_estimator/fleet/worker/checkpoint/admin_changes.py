"""Changes of checkpoints by an administrator: restoration of an earlier day, and erasure of packs from the server.

Each change claims the partition as a worker does. The owner is thereby fenced out, drops the partition from its memory, and takes it
over again from the changed checkpoints. An erasure covers blocks, dead letters, states in checkpoints and in the memory of workers,
and hourly rows. The other packs of a partition lose nothing, because their blocks since the rewritten checkpoint are in the stream.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from datetime import UTC, date, datetime
from functools import partial
from typing import Any, TypeVar

import nats.errors
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, CheckpointPointer, pointer_key
from bms_estimator.fleet.nats.connection import RETRY_S
from bms_estimator.fleet.nats.message_erasure import erase_messages
from bms_estimator.fleet.nats.streams import PRIORITY_GROUP, RESPONSE_TIMEOUT_S, consumer, require_partitions
from bms_estimator.fleet.packs.pack_bucket import POLL_S, purge_keys, remove_keys
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import (
    CheckpointError,
    PartitionCheckpoint,
    UnreadableFormatError,
    read_checkpoint,
)
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore, open_checkpoints
from bms_estimator.fleet.worker.checkpoint.claims import FencedError
from bms_estimator.model.errors import UserError

RESTORE_NAME, ERASE_NAME = "checkpoints-restore", "packs-remove"
"""Names with which the commands claim partitions."""
MAX_CLAIMS = 20
"""Maximum number of attempts to claim a partition. Its worker may claim it back before its checkpoints are changed."""
TABLE_REFRESH_S = 3.0 * POLL_S
"""Waiting time until all workers have removed a pack from their copies of the table [s]."""
MAX_PACK_TOKEN = 5
"""Last token of a subject, counted from 1, that may be a pack's name in the streams of other programs. Assumed, because
their subjects are unknown."""
V = TypeVar("V")


async def change_checkpoints(nc: Client, partition: int, change: Callable[[], Awaitable[None]]) -> None:
    """Change the checkpoints of a partition, and let its worker take it over again.

    Args:
        nc: Connection to the tenant's NATS account.
        partition: Number of the partition.
        change: Claims the partition and changes its checkpoints. It is repeated if a worker claims the partition meanwhile.

    Raises:
        UserError: A worker claims the partition at each attempt.
    """
    for _ in range(MAX_CLAIMS):
        try:
            await change()
            break
        except FencedError:
            await asyncio.sleep(RETRY_S)
    else:
        raise UserError(
            f"partition {partition}: its worker claims it at each attempt; end the workers and repeat the command"
        )
    # a worker whose pin ends checks its claim, finds it replaced, and drops the partition from its memory
    request = f"$JS.API.CONSUMER.UNPIN.{subjects.RAW_STREAM}.{consumer(partition)}"
    with suppress(nats.errors.TimeoutError):
        await nc.request(request, json.dumps({"group": PRIORITY_GROUP}).encode(), timeout=RESPONSE_TIMEOUT_S)


def day_of(info: CheckpointInfo) -> date:
    """Return the UTC day on which a checkpoint was written."""
    return datetime.fromtimestamp(info.made_s, UTC).date()


async def read_pointers(nc: Client) -> dict[int, CheckpointPointer]:
    """Return the pointers to the checkpoints, by partition.

    Raises:
        UserError: The server has no streams.
    """
    partitions = await require_partitions(nc)
    entries = await read_bucket(nc, subjects.CHECKPOINTS_BUCKET)
    keys = {number: pointer_key(number) for number in range(partitions)}
    return {
        number: CheckpointPointer.model_validate_json(entries[key]) for number, key in keys.items() if key in entries
    }


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
        UserError: No partition has a checkpoint of the day; or a checkpoint is damaged, or has a format that this program
            cannot read.
    """
    pointers = await read_pointers(nc)
    daily_checkpoints = {
        number: info
        for number, pointer in pointers.items()
        for info in pointer.daily
        if day_of(info) == day and (not partitions or number in partitions)
    }
    if not daily_checkpoints:
        days = sorted({day_of(info) for pointer in pointers.values() for info in pointer.daily})
        raise UserError(f"{day}: no checkpoint of this day; there are those of {', '.join(map(str, days)) or 'no day'}")
    store = await open_checkpoints(nc, RESTORE_NAME)
    last = (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.last_seq if skip_blocks else None
    for number, info in daily_checkpoints.items():
        await change_checkpoints(nc, number, partial(_restore, store, number, info, last))
    return daily_checkpoints


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
    # in the format of the last checkpoint, which the workers in use can read, even if they are of an earlier version
    await store.replace_last(claim, checkpoint, file_format=claim.pointer.kept[0].format)


@dataclass(frozen=True)
class Erasure:
    """Numbers of erased items of one pack, and remaining messages.

    Attributes:
        blocks: Number of blocks in the stream ``RAW``.
        dead_letters: Number of messages in the stream ``DEAD``.
        checkpoints: Number of checkpoints that contained the pack.
        hours: Number of messages in the stream ``HOURS``.
        remaining: Numbers of messages with the pack's name in their subject in the other streams of the tenant, by stream.
    """

    blocks: int
    dead_letters: int
    checkpoints: int
    hours: int
    remaining: Mapping[str, int]


async def erase_packs(nc: Client, packs: Collection[str]) -> dict[str, Erasure]:
    """Remove packs from the table and erase them from the server.

    Args:
        nc: Connection to the tenant's NATS account, with the permissions of its administrator.
        packs: Names of the packs.

    Raises:
        UserError: The server has no streams, or the last checkpoint of a partition has a format that this program cannot
            read; then nothing is erased.
        StreamError: The server does not respond, or rejects reading a stream.
        nats.errors.Error: The server rejects another request.
    """
    partitions = await require_partitions(nc)
    store = await open_checkpoints(nc, ERASE_NAME)
    numbers = {subjects.partition_of(pack, partitions) for pack in packs}
    for number in numbers:
        await _check_readable(store, number)
    listed = packs & (await read_bucket(nc, subjects.PACKS_BUCKET)).keys()
    if listed:
        await remove_keys(nc, subjects.PACKS_BUCKET, listed)
        await asyncio.sleep(TABLE_REFRESH_S)  # otherwise a worker may process a new block with the former settings
    blocks, checkpoints = dict[str, int](), dict[str, int]()
    for number in numbers:
        packs_of_partition = {pack for pack in packs if subjects.partition_of(pack, partitions) == number}
        for pack in packs_of_partition:
            blocks[pack] = await erase_messages(nc, subjects.RAW_STREAM, subjects.stored_raw(number, pack))
            # the changes of the pack's row in the table, and the results of its fits
            await erase_messages(nc, subjects.RAW_STREAM, subjects.stored(number, pack))
        checkpoints |= await _erase_states(nc, store, number, packs_of_partition)
    dead_letters = {pack: await erase_messages(nc, subjects.DEAD_STREAM, subjects.dead(pack)) for pack in packs}
    hours = {pack: await erase_messages(nc, subjects.HOURS_STREAM, subjects.hours(pack)) for pack in packs}
    for pack in packs:
        # ``erase_messages`` needs direct gets, which this stream does not allow. Its messages hold no data of the pack that would
        # have to be overwritten, only sequence numbers.
        await nc.jetstream().purge_stream(subjects.FITS_STREAM, subject=subjects.fit_request(pack))
        await erase_messages(nc, subjects.HISTORY_STREAM, subjects.history(pack))
    await purge_keys(nc, subjects.PACKS_BUCKET, packs)
    remaining = await _remaining(nc, packs)
    return {
        pack: Erasure(blocks[pack], dead_letters[pack], checkpoints[pack], hours[pack], remaining[pack])
        for pack in packs
    }


async def _check_readable(store: CheckpointStore, partition: int) -> None:
    """Check that the last checkpoint of a partition can be rewritten.

    Raises:
        UserError: The checkpoint has a format that this program cannot read.
    """
    try:
        await store.claims.check_format(partition)
    except UnreadableFormatError as error:
        raise _later_version_error(partition, error) from None


def _later_version_error(partition: int, error: UnreadableFormatError) -> UserError:
    """Return an error that continues the text of ``error``, which ends with the version of worker to start."""
    return UserError(f"partition {partition}: {error}, and erase the packs with that version")


async def _erase_states(nc: Client, store: CheckpointStore, partition: int, packs: Collection[str]) -> dict[str, int]:
    """Erase packs from all checkpoints of a partition and from its worker's memory. Return numbers of checkpoints by pack."""
    counts = dict.fromkeys(packs, 0)
    try:
        await change_checkpoints(nc, partition, lambda: _rewrite_checkpoints(store, partition, counts))
    except UnreadableFormatError as error:
        raise _later_version_error(partition, error) from None
    return counts


async def _rewrite_checkpoints(store: CheckpointStore, partition: int, counts: dict[str, int]) -> None:
    """Remove the packs that are the keys of ``counts`` from all checkpoints. Add the number of changed checkpoints to each value.

    Damaged and unreadable checkpoints are removed, because they may contain the packs. The newest intact one must be readable.

    Raises:
        FencedError: A worker has claimed the partition meanwhile.
        UnreadableFormatError: The newest intact checkpoint has a format that this program cannot read.
    """
    claim = await store.claim(partition)
    checkpoints = claim.pointer.checkpoints
    readable = set[CheckpointInfo]()
    async for info, data in store.load(claim):
        try:
            checkpoint = read_checkpoint(data)
        except UnreadableFormatError:
            if not readable:  # its removal would lose the learned parameters
                raise
            continue
        except CheckpointError:
            continue
        readable.add(info)
        by_pack = _fields_by_pack(checkpoint)
        erased = {pack for pack in counts if any(pack in part for part in by_pack.values())}
        # a checkpoint with a damaged increment is readable up to it; the increment, which may contain the packs, is removed
        if erased or store.is_damaged(info):
            parts: dict[str, Any] = {name: _without(part, erased) for name, part in by_pack.items()}
            rest = replace(checkpoint, **parts)
            claim = await store.replace(claim, info, rest.chunks(info.format))
        for pack in erased:
            counts[pack] += 1
    for info in checkpoints:
        if info not in readable:
            claim = await store.replace(claim, info, None)


def _fields_by_pack(checkpoint: PartitionCheckpoint) -> dict[str, Any]:
    """Return the mappings of a checkpoint whose keys are names of packs."""
    parts = {field.name: getattr(checkpoint, field.name) for field in fields(checkpoint)}
    return {name: part for name, part in parts.items() if isinstance(part, Mapping) and name != "counters"}


def _without(part: Mapping[str, V], packs: Collection[str]) -> dict[str, V]:
    return {pack: value for pack, value in part.items() if pack not in packs}


async def _remaining(nc: Client, packs: Collection[str]) -> dict[str, dict[str, int]]:
    """Return the numbers of messages with a pack's name in their subject, by pack and stream."""
    remaining: dict[str, dict[str, int]] = {pack: {} for pack in packs}
    js = nc.jetstream()
    for stream in [info.config.name or "" for info in await js.streams_info()]:
        for pack in packs:
            infos = [await js.stream_info(stream, each) for each in _pack_subjects(stream, pack)]
            if count := sum(sum((info.state.subjects or {}).values()) for info in infos):
                remaining[pack][stream] = count
    return remaining


def _pack_subjects(stream: str, pack: str) -> list[str]:
    """Return patterns of the subjects of a stream that contain a pack's name.

    In a stream of another program, the name may be at any position. In a stream of the fleet, only the position of the pack's
    name counts, because a pack may be named like a partition, such as ``p0``.
    """
    fleet_subjects = {
        subjects.RAW_STREAM: [f"p.*.*.{pack}"],
        subjects.HOURS_STREAM: [subjects.hours(pack)],
        subjects.DEAD_STREAM: [subjects.dead(pack)],
        subjects.HISTORY_STREAM: [subjects.history(pack)],
        subjects.FITS_STREAM: [subjects.fit_request(pack)],
        f"KV_{subjects.PACKS_BUCKET}": [f"$KV.{subjects.PACKS_BUCKET}.{pack}"],
        f"KV_{subjects.CELLS_BUCKET}": [],
        f"KV_{subjects.CHECKPOINTS_BUCKET}": [],
        f"OBJ_{subjects.STATES_BUCKET}": [],
    }
    if stream in fleet_subjects:
        return fleet_subjects[stream]
    leading = [".".join(["*"] * tokens) for tokens in range(1, MAX_PACK_TOKEN)]
    return [f"{each}.{pack}{rest}" for each in leading for rest in ("", ".>")]
