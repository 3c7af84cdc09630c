"""Erasure of packs from the server: blocks, dead letters, states in checkpoints and in the memory of workers, hourly rows.

The other packs of a partition lose nothing, because their blocks since the rewritten checkpoint are in the stream.
"""

import asyncio
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo
from bms_estimator.fleet.nats.message_erasure import erase_messages
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.fleet.nats.streams import RESPONSE_TIMEOUT_S, require_partitions
from bms_estimator.fleet.packs.pack_bucket import POLL_S, purge_keys, read_bucket, remove_keys
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import PartitionCheckpoint, read_checkpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore, open_checkpoints
from bms_estimator.fleet.worker.checkpoint.claims import change_checkpoints
from bms_estimator.fleet.worker.checkpoint.format_versions import CheckpointError, UnreadableFormatError
from bms_estimator.model.errors import UserError

WORKER_NAME = "packs-remove"
"""Name with which the erasure claims a partition."""
TABLE_S = 3.0 * POLL_S
"""Waiting time until all workers have removed a pack from their copies of the table [s]."""
MAX_TOKENS = 5
"""Maximum position of a pack's name in a subject [tokens]."""
V = TypeVar("V")


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
        UserError: The server has no streams, or the last checkpoint of a partition is of a version that this one cannot
            read; then nothing is erased.
        StreamError: The server rejects a request.
    """
    partitions = await require_partitions(nc)
    store = await open_checkpoints(nc, WORKER_NAME)
    numbers = {subjects.partition_of(pack, partitions) for pack in packs}
    for number in numbers:
        await _check_readable(store, number)
    listed = packs & (await read_bucket(nc, subjects.PACKS_BUCKET)).keys()
    if listed:
        await remove_keys(nc, subjects.PACKS_BUCKET, listed)
        await asyncio.sleep(TABLE_S)  # otherwise a worker may process a new block with the former settings
    blocks, checkpoints = dict[str, int](), dict[str, int]()
    for number in numbers:
        members = {pack for pack in packs if subjects.partition_of(pack, partitions) == number}
        for pack in members:
            blocks[pack] = await erase_messages(nc, subjects.RAW_STREAM, subjects.stored_raw(number, pack))
            await erase_messages(nc, subjects.RAW_STREAM, subjects.stored(number, pack))  # changes of its row, fits
        checkpoints |= await _erase_states(nc, store, number, members)
    dead_letters = {pack: await erase_messages(nc, subjects.DEAD_STREAM, subjects.dead(pack)) for pack in packs}
    hours = {pack: await erase_messages(nc, subjects.HOURS_STREAM, subjects.hours(pack)) for pack in packs}
    for pack in packs:
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
        UserError: It is of a version that this one cannot read.
    """
    try:
        await store.claims.check_format(partition)
    except UnreadableFormatError as error:
        raise _later_version_error(partition, error) from None


def _later_version_error(partition: int, error: UnreadableFormatError) -> UserError:
    return UserError(f"partition {partition}: {error}, and erase with that version")


async def _erase_states(nc: Client, store: CheckpointStore, partition: int, packs: Collection[str]) -> dict[str, int]:
    """Erase packs from all checkpoints of a partition and from its worker's memory. Return numbers of checkpoints by pack."""
    counts = dict.fromkeys(packs, 0)
    try:
        await change_checkpoints(nc, partition, lambda: _rewrite_checkpoints(store, partition, counts))
    except UnreadableFormatError as error:
        raise _later_version_error(partition, error) from None
    return counts


async def _rewrite_checkpoints(store: CheckpointStore, partition: int, counts: dict[str, int]) -> None:
    """Rewrite the checkpoints that contain one of the packs of ``counts``, and count them there.

    Damaged checkpoints are removed, and those of a version that this one cannot read, except the newest intact one.

    Raises:
        FencedError: A worker has claimed the partition meanwhile.
        UnreadableFormatError: The newest intact checkpoint is of a version that this one cannot read.
    """
    claim = await store.claim(partition)
    checkpoints = claim.pointer.checkpoints
    readable = set[CheckpointInfo]()
    async for info, data in store.load(claim):
        try:
            checkpoint = read_checkpoint(data)
        except UnreadableFormatError:
            if not readable:  # its removal would lose what was learned
                raise
            continue
        except CheckpointError:
            continue
        readable.add(info)
        by_pack = _fields_by_pack(checkpoint)
        found = {pack for pack in counts if any(pack in part for part in by_pack.values())}
        if found or store.is_damaged(info):  # the content of a damaged increment is unknown
            parts: dict[str, Any] = {name: _without(part, found) for name, part in by_pack.items()}
            rest = replace(checkpoint, **parts)
            claim = await store.replace(claim, info, rest.chunks(info.format))
        for pack in found:
            counts[pack] += 1
    for info in checkpoints:
        if info not in readable:  # its content is unknown
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
    for stream in (await _api(nc, "STREAM.NAMES", {}))["streams"] or ():
        for pack in packs:
            count = await _count_messages(nc, stream, pack)
            if count:
                remaining[pack][stream] = count
    return remaining


async def _count_messages(nc: Client, stream: str, pack: str) -> int:
    """Return the number of a stream's messages with a pack's name in their subject."""
    count = 0
    for subject in _pack_subjects(stream, pack):
        info = await _api(nc, f"STREAM.INFO.{stream}", {"subjects_filter": subject})
        count += sum((info["state"].get("subjects") or {}).values())
    return count


def _pack_subjects(stream: str, pack: str) -> list[str]:
    """Return the subjects of a stream with a pack's name, with wildcards; for a stream of another program at any position.

    In the other streams of the fleet, a pack's name may also be that of a partition, such as ``p0``.
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
    leading = [".".join(["*"] * tokens) for tokens in range(1, MAX_TOKENS)]
    return [f"{each}.{pack}{rest}" for each in leading for rest in ("", ".>")]


async def _api(nc: Client, operation: str, request: dict[str, Any]) -> dict[str, Any]:
    """Send a request to the JetStream API, because nats-py does not support filters of subjects.

    Raises:
        StreamError: The server rejects the request.
    """
    response = await nc.request(f"$JS.API.{operation}", json.dumps(request).encode(), timeout=RESPONSE_TIMEOUT_S)
    decoded: dict[str, Any] = json.loads(response.data)
    if "error" in decoded:
        raise StreamError(f"the server rejects {operation}: {decoded['error'].get('description', '')}")
    return decoded
