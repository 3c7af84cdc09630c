"""Blocks that no worker can process: ones that kill their worker, and ones of a later version."""

import asyncio
import sys
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS
from bms_estimator.fleet.nats.dead_letters import DeadLetter, read_dead_letters, replay_letter
from bms_estimator.fleet.worker.block_result import LETHAL, BlockResult, ResultPublisher
from bms_estimator.fleet.worker.worker import Options, work
from tests.command_line import PROGRAM, run, running_program
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.partition_stream import estimates_of
from tests.fleet.worker import later_blocks, lethal_block
from tests.fleet.worker.later_blocks import later_block
from tests.fleet.workers import (
    STORE_ID_NS,
    Process,
    block,
    end_states,
    estimated,
    load_packs,
    samples,
    send,
)


async def fleet(cluster: NatsCluster, *command: object) -> tuple[int | None, str]:
    """Run a command of ``fleet`` on the server. Return exit code and stdout."""
    async with running_program(PROGRAM, "fleet", *command, "--server", cluster.url) as process:
        out, _ = await process.communicate()
    return process.returncode, out.decode()


def lethal(pack: str, number: int) -> bytes:
    """Return a block that kills the worker of ``lethal_block``."""
    rows = samples(pack, number)
    rows["temperature_c"] = lethal_block.TEMPERATURE_C
    return encode(Block(store_created_ns=STORE_ID_NS, number=number, oldest=1, arrival_s=1.79e9, samples=rows))


async def test_hourly_rows_are_stored_although_a_dead_letter_cannot_be_stored(nc) -> None:
    js, results = nc.jetstream(), ResultPublisher(nc)
    await js.delete_stream(subjects.DEAD_STREAM)
    letter = DeadLetter("p1", 1, LETHAL, "w", b"")
    results.queue_dead_letter(letter)
    results.queue(BlockResult("p1", hours=(("p1-1", b"row"),)))
    with pytest.raises(RETRYABLE_ERRORS):
        await results.send_queued()
    assert [each.subject for each in results.waiting] == [letter.subject]
    assert (await js.stream_info(subjects.HOURS_STREAM)).state.messages == 1


@pytest.mark.thorough
async def test_block_that_kills_its_workers_is_skipped_and_stored_as_a_dead_letter(
    nc, cluster, heartbeats, tmp_path
) -> None:
    registry = await load_packs(nc, ["p1", "p2"])
    for number in (1, 2, 3):
        await send(nc, "p1", lethal("p1", 2) if number == 2 else block("p1", number))
        await send(nc, "p2", block("p2", number))
    worker = Process(tmp_path, cluster.url, "w", program=(sys.executable, Path(lethal_block.__file__)))
    try:
        await heartbeats.until(lambda last: "w" in last and last["w"].dead_letters == 1)
        await heartbeats.until(lambda last: last["w"].counters.get("blocks") == 5)
        assert await worker.end() == 0
    finally:
        worker.kill()
    (letter,) = await read_dead_letters(nc)
    assert (letter.pack, letter.data, letter.reason, letter.worker) == ("p1", lethal("p1", 2), LETHAL, "w")
    assert len([line for line in worker.lines if line["event"] == "ready"]) == 5  # deaths: 2 unguarded, 2 guarded
    code, out = await fleet(cluster, "dead-letters", "list")
    assert (code, f"{letter.sequence}" in out, LETHAL in out) == (0, True, True)
    partition = (await end_states(nc, registry, 1))[0]
    assert estimates_of(partition.state("p2")["estimator"]) == estimated(registry, "p2", 3)
    estimator = make_estimator(*registry("p1"))
    estimator.run(np.concatenate([samples("p1", number) for number in (1, 3)]))
    assert estimates_of(partition.state("p1")["estimator"]) == estimates_of(estimator.record)


@pytest.mark.thorough
async def test_blocks_of_a_later_version_are_processed_by_a_replay_after_the_upgrade_of_the_workers(
    nc, cluster, heartbeats, tmp_path
) -> None:
    registry = await load_packs(nc, ["p1", "p2"])
    old = Process(tmp_path, cluster.url, "old")
    try:
        for number in (1, 2, 1, 2):  # an edge sends a block again until a worker confirms it
            await nc.jetstream().publish(subjects.raw("p1"), later_block(block("p1", number)))
        await heartbeats.until(lambda last: "old" in last and last["old"].dead_letters == 4)
        code, out = await fleet(cluster, "status", "--blocks", later_blocks.VERSION)
        assert (code, "unreadable for old: upgrade these workers first" in out) == (1, True)
        assert "p1: dead letter: version" in out
        assert await old.end() == 0
    finally:
        old.kill()
    new = Process(tmp_path, cluster.url, "new", program=(sys.executable, Path(later_blocks.__file__)))
    try:
        await heartbeats.until_held(1, "new")
        assert (await fleet(cluster, "status", "--blocks", later_blocks.VERSION))[0] == 0
        assert await fleet(cluster, "dead-letters", "replay", "p1") == (0, "replayed 2 blocks of 1 pack: p1\n")
        assert "dead letter" not in (await fleet(cluster, "status"))[1]
        await heartbeats.until(lambda last: last["new"].blocks == 2)
        assert await new.end() == 0
    finally:
        new.kill()
    assert await read_dead_letters(nc) == []
    partition = (await end_states(nc, registry, 1))[0]
    assert estimates_of(partition.state("p1")["estimator"]) == estimated(registry, "p1", 2)


async def test_block_that_cannot_be_decoded_is_stored_as_a_dead_letter_and_can_be_replayed(
    nc, cluster, heartbeats, capsys
) -> None:
    await load_packs(nc, ["p1"])
    await send(nc, "p1", b"damaged")
    stop = asyncio.Event()
    working = asyncio.create_task(work(Options(cluster.url, "w"), stop))
    await heartbeats.until(lambda last: "w" in last and last["w"].dead_letters == 1)
    stop.set()
    await working
    (letter,) = await read_dead_letters(nc)
    assert (letter.pack, letter.data, letter.worker) == ("p1", b"damaged", "w")
    command = run, capsys, "fleet", "dead-letters"
    code, out, _ = await asyncio.to_thread(*command, "list", "--server", cluster.url)
    assert (code, letter.reason in out) == (0, True)
    code, out, _ = await asyncio.to_thread(*command, "replay", "p1", "--server", cluster.url)
    assert (code, out) == (0, "replayed 1 block of 1 pack: p1\n")
    assert await read_dead_letters(nc) == []


async def test_replay_keeps_the_dead_letter_that_a_worker_stores_of_the_replayed_block(nc) -> None:
    letter = DeadLetter("p1", 1, "damaged", "w", b"a damaged block")
    await nc.jetstream().publish(letter.subject, letter.data, headers=letter.headers())
    (stored,) = await read_dead_letters(nc)
    again = letter._replace(sequence=2)
    await nc.jetstream().publish(again.subject, again.data, headers=again.headers())
    await replay_letter(nc, stored)
    assert [each.sequence for each in await read_dead_letters(nc)] == [2]
    await replay_letter(nc, (await read_dead_letters(nc))[0])
    assert await read_dead_letters(nc) == []
