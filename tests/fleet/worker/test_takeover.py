"""Deaths of holders in a guarded replay, counted on the real server."""

import asyncio

import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.takeover import GUARDED_CLAIMS, MAX_DEATHS, ReplayGuard
from bms_estimator.process.runtime import end_tasks
from tests.fleet.checkpoints import raw

END_SEQUENCE = 9
"""Sequence number of the last message of the replay."""


async def claim_after_a_death(store: CheckpointStore) -> ReplayGuard:
    """Return the guard of a worker that claims the partition without a checkpoint of the former holder."""
    guard = ReplayGuard(store.replays, 0)
    await guard.begin(await store.claim(0), END_SEQUENCE)
    return guard


async def claim_guarded(store: CheckpointStore) -> ReplayGuard:
    """Return the guard of the first worker whose replay is guarded."""
    for _ in range(GUARDED_CLAIMS):
        await claim_after_a_death(store)
    return await claim_after_a_death(store)


async def test_block_in_which_several_holders_died_is_lethal(store: CheckpointStore) -> None:
    guard = await claim_guarded(store)
    for _ in range(MAX_DEATHS):
        assert not await guard.begin_block(5)
        guard = await claim_after_a_death(store)
    assert await guard.begin_block(5)
    assert not await guard.begin_block(6)


async def test_block_that_its_holders_survived_is_not_lethal(store: CheckpointStore) -> None:
    guard = await claim_guarded(store)
    for _ in range(MAX_DEATHS + 1):
        assert not await guard.begin_block(5)
        await guard.end_block(5)  # the holder dies later, from another cause
        guard = await claim_after_a_death(store)


async def test_blocks_after_the_replay_are_not_written_down(store: CheckpointStore) -> None:
    guard = await claim_guarded(store)
    assert not await guard.begin_block(END_SEQUENCE + 1)
    assert (await store.replays.read(0)).sequence == 0


async def test_guarded_replay_does_not_wait_for_the_leader_of_the_bucket(nc: Client, store: CheckpointStore) -> None:
    guard = await claim_guarded(store)
    await nc.jetstream().delete_stream(f"KV_{subjects.CHECKPOINTS_BUCKET}")
    assert not await guard.begin_block(5)


async def test_worker_that_is_stopped_in_a_guarded_replay_can_write_its_checkpoint(store: CheckpointStore) -> None:
    guard = await claim_guarded(store)
    beginning = asyncio.create_task(guard.begin_block(5))
    for _ in range(3):  # until it waits for the receipt
        await asyncio.sleep(0)
    await end_tasks(beginning)
    await store.claims.read(0)  # not possible if the connection is no longer read


@pytest.mark.parametrize("is_saved", [True, False], ids=["after a checkpoint", "after an orderly release"])
async def test_replay_is_not_guarded(store: CheckpointStore, is_saved: bool) -> None:
    await claim_guarded(store)
    claim = await store.claim(0)
    if is_saved:
        await store.write(claim, raw(1, b"1"), file_format=FORMAT)
    else:
        await store.claims.record_release(claim)
    guard = await claim_after_a_death(store)
    assert not await guard.begin_block(5)
    assert (await store.replays.read(0)).sequence == 0
