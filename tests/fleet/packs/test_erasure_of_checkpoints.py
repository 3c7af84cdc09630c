"""``fleet packs remove --erase`` with checkpoints of several days and formats, dead letters and changes of the table."""

import asyncio
from dataclasses import replace

import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.nats.dead_letters import DeadLetter, read_dead_letters
from bms_estimator.fleet.packs.table_change import PackSource, encode_change
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT, PartitionCheckpoint, read_checkpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.claims import Claim
from tests.command_line import run
from tests.fleet.checkpoints import DAY_S, damage, raw, stored_objects
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.workers import PACK_ROW, block, load_packs, send


async def erase(capsys: pytest.CaptureFixture[str], cluster: NatsCluster, pack: str) -> tuple[int, str, str]:
    """Erase a pack with the command. Return exit code, stdout and stderr."""
    command = ("fleet", "packs", "remove", pack, "--erase", "--server", cluster.url)
    return await asyncio.to_thread(run, capsys, *command)


async def write(store: CheckpointStore, claim: Claim, file_format: int, sequence: int = 1) -> Claim:
    """Write a checkpoint of two packs."""
    source = PackSource(PACK_ROW.decode(), None)
    checkpoint = PartitionCheckpoint(
        0, sequence, packs={"p1": b"first", "p2": b"second"}, in_force={"p1": source, "p2": source}
    )
    return await store.write(claim, checkpoint, file_format=file_format)


async def test_pack_is_erased_from_daily_checkpoints_of_both_formats_and_the_other_pack_stays(
    nc, cluster, store, clock, capsys
) -> None:
    claim = await store.claim(0)
    for file_format in (FORMAT - 1, FORMAT - 1, FORMAT, FORMAT):
        clock.now_s += DAY_S
        claim = await write(store, claim, file_format)
    code, out, err = await erase(capsys, cluster, "p1")
    assert (code, err) == (0, "")
    assert "the state in 4 checkpoints erased" in out
    claim = await store.claim(0)
    loaded = [(info.format, read_checkpoint(data)) async for info, data in store.load(claim)]
    assert [file_format for file_format, _ in loaded] == [FORMAT, FORMAT, FORMAT - 1, FORMAT - 1]
    assert [dict(each.packs) for _, each in loaded] == 4 * [{"p2": b"second"}]
    assert [list(each.in_force) for _, each in loaded] == 4 * [["p2"]]


@pytest.mark.parametrize("damaged_increment", [None, 1])
async def test_pack_is_erased_from_increments_and_from_the_daily_checkpoint_before_them(
    nc, cluster, store, clock, capsys, damaged_increment
) -> None:
    records = {f"p{number}": f"record {number} ".encode() * 1000 for number in range(1, 9)}
    whole = PartitionCheckpoint(0, 1, packs=records)
    claim = await store.write(await store.claim(0), whole, file_format=FORMAT)
    for sequence, pack in ((2, "p1"), (3, "p2")):
        changed = replace(whole, sequence=sequence, packs=records | {pack: b"changed"}, changed={pack})
        claim = await store.write(claim, changed, file_format=FORMAT)
    (last,) = claim.pointer.kept
    assert len(last.increments) == 2
    if damaged_increment is not None:
        await damage(nc, last.increments[damaged_increment])
    code, out, err = await erase(capsys, cluster, "p1")
    assert (code, err) == (0, "")
    assert "the state in 2 checkpoints erased" in out
    claim = await store.claim(0)
    loaded = [read_checkpoint(data) async for _, data in store.load(claim)]
    others = {pack: record for pack, record in records.items() if pack != "p1"}
    last_saved = others if damaged_increment is not None else others | {"p2": b"changed"}
    assert [dict(each.packs) for each in loaded] == [last_saved, others]
    assert await stored_objects(nc) == claim.pointer.objects
    assert not claim.pointer.objects & set(last.objects)


async def test_dead_letters_and_table_changes_of_the_pack_are_erased(nc, cluster, capsys) -> None:
    for pack in ("p1", "p2"):
        letter = DeadLetter(pack, 1, "damaged", "w", b"a damaged block")
        await nc.jetstream().publish(letter.subject, letter.data, headers=letter.headers())
        await nc.jetstream().publish(subjects.table_change(pack), encode_change(None))
    code, out, err = await erase(capsys, cluster, "p1")
    assert (code, err) == (0, "")
    assert "1 dead letter," in out
    assert "remain in the stream" not in out
    assert [letter.pack for letter in await read_dead_letters(nc)] == ["p2"]
    remaining = (await nc.jetstream().stream_info(subjects.RAW_STREAM, subjects_filter=">")).state.subjects
    assert list(remaining or {}) == [subjects.stored(0, "p2").replace("*", "table")]


async def test_nothing_is_erased_while_the_last_checkpoint_is_of_a_later_version(nc, cluster, store, capsys) -> None:
    await load_packs(nc, ["p1"])
    await send(nc, "p1", block("p1", 1))
    claim = await write(store, await store.claim(0), FORMAT + 1)
    code, out, err = await erase(capsys, cluster, "p1")
    assert (code, out) == (2, "")
    assert f"partition 0: the checkpoint is of format {FORMAT + 1}" in err
    assert await store.claims.confirm(claim) == claim
    assert "p1" in await read_bucket(nc, subjects.PACKS_BUCKET)
    assert (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.messages == 1


def later_checkpoint() -> bytes:
    """Return a checkpoint of a later version."""
    data = bytearray(b"".join(PartitionCheckpoint(0, 1, packs={"p1": b"first"}).chunks()))
    data[8] = FORMAT + 1  # the format's offset in a checkpoint
    return bytes(data)


async def test_newest_intact_checkpoint_of_a_later_version_stays_although_its_pointer_names_a_readable_format(
    nc, cluster, store, capsys
) -> None:
    claim = await store.write(await store.claim(0), raw(1, later_checkpoint()), file_format=FORMAT)
    code, out, err = await erase(capsys, cluster, "p1")
    assert (code, out) == (2, "")
    assert f"partition 0: the checkpoint is of format {FORMAT + 1}" in err
    assert [data async for _, data in store.load(await store.claim(0))] == [later_checkpoint()]
    assert claim.pointer.kept == (await store.claim(0)).pointer.kept


async def test_earlier_checkpoints_of_a_later_version_are_removed_because_they_cannot_be_rewritten(
    nc, cluster, store, clock, capsys
) -> None:
    claim = await store.claim(0)
    claim = await store.write(claim, raw(1, later_checkpoint()), file_format=FORMAT + 1)
    clock.now_s += DAY_S
    claim = await write(store, claim, FORMAT, sequence=2)
    code, _, err = await erase(capsys, cluster, "p1")
    assert (code, err) == (0, "")
    claim = await store.claim(0)
    assert [info.sequence async for info, _ in store.load(claim)] == [2]
    assert await stored_objects(nc) == {info.object for info in claim.pointer.checkpoints}


async def forget_daily_checkpoints(store: CheckpointStore, nc: Client, claim: Claim) -> None:
    """Replace the pointer as a worker of a version without daily checkpoints does."""
    bucket = await nc.jetstream().key_value(subjects.CHECKPOINTS_BUCKET)
    await bucket.put("p0", claim.pointer.model_dump_json(exclude={"daily", "unsaved_claims"}).encode())


async def test_daily_checkpoints_that_a_rolled_back_worker_forgot_are_removed_by_the_next_claim(
    nc, store, clock
) -> None:
    claim = await store.claim(0)
    for _ in range(4):
        clock.now_s += DAY_S
        claim = await write(store, claim, FORMAT)
    other = await write(store, await store.claim(10), FORMAT)  # another partition, whose number begins alike
    await forget_daily_checkpoints(store, nc, claim)
    claim = await store.claim(0)
    expected = {info.object for info in (*claim.pointer.checkpoints, *other.pointer.checkpoints)}
    assert await stored_objects(nc) == expected
    assert len(claim.pointer.checkpoints) == 2


@pytest.mark.parametrize("pack", ["p0", "raw"])
async def test_pack_that_is_named_like_a_partition_or_another_part_of_a_subject_does_not_seem_to_remain(
    nc, cluster, store, capsys, pack
) -> None:
    await write(store, await store.claim(0), FORMAT)
    await send(nc, "p2", block("p2", 1))
    code, out, err = await erase(capsys, cluster, pack)
    assert (code, err) == (0, "")
    assert "remain in the stream" not in out
