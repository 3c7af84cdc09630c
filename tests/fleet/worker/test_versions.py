"""Workers of two versions side by side: upgrade, roll-back, and checkpoints that a version cannot read."""

import asyncio
import sys
import time
import zipfile
from contextlib import ExitStack
from pathlib import Path

import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import RefusedPartition
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import FORMAT
from bms_estimator.fleet.worker.partition import Partition
from tests.command_line import PROGRAM, running_program
from tests.deploy.built_version import link_project, versions
from tests.deploy.core_environment import build_wheel
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.partition_stream import estimates_of
from tests.fleet.worker import later_version
from tests.fleet.worker.later_version import DOWNGRADED, UPGRADED
from tests.fleet.workers import Process, block, end_states, estimated, load_packs, send
from tests.patience import LONG_S

PARTITIONS = 2
PACKS = ["p1", "p2"]
"""One pack of each partition."""
IDLE_PACKS = [f"p{number}" for number in range(3, 11)]
"""Packs of both partitions that send only one block."""
TWO_FORMATS, UNREADABLE_FORMAT = FORMAT + 1, FORMAT + 2
"""Format of a version that also reads the format of this version, and of a version that does not."""


@pytest.fixture(scope="module")
def partitions() -> int:
    return PARTITIONS


class Workers:
    """Workers of several versions on one server.

    Args:
        folder: Folder of their logs.
        url: URL of the server.
    """

    def __init__(self, folder: Path, url: str) -> None:
        self._folder, self._url, self.stack = folder, url, ExitStack()

    def start(self, name: str, newest_format: int | None = None) -> Process:
        """Start a worker of this version, or of a later one whose newest format is ``newest_format``."""
        script = Path(later_version.__file__)
        program = (PROGRAM,) if newest_format is None else (sys.executable, script, newest_format)
        worker = Process(self._folder, self._url, name, "--checkpoint-s", 1, program=program)
        self.stack.callback(worker.kill)
        return worker


@pytest.fixture
def workers(tmp_path: Path, cluster: NatsCluster):
    workers = Workers(tmp_path, cluster.url)
    with workers.stack:
        yield workers


async def send_blocks(nc: Client, number: int) -> None:
    """Send block ``number`` of each pack. The idle packs send only their first block, before the others."""
    for pack in (*IDLE_PACKS, *PACKS) if number == 1 else PACKS:
        await send(nc, pack, block(pack, number))


async def pointers(nc: Client) -> list[CheckpointPointer]:
    """Return the pointers to the checkpoints of all claimed partitions."""
    entries = await read_bucket(nc, subjects.CHECKPOINTS_BUCKET)
    return [CheckpointPointer.model_validate_json(entries[key]) for key in sorted(entries)]


async def until_saved(nc: Client, *, blocks: int, file_format: int) -> list[CheckpointPointer]:
    """Wait until the last checkpoints include all blocks and have a format, and return the pointers to them.

    Args:
        nc: Connection to the server.
        blocks: Number of blocks that each pack except the idle ones has sent. The last two messages of the stream are of both
            partitions.
        file_format: Format of the last checkpoints.
    """
    last_sequence = len(IDLE_PACKS) + blocks * len(PACKS)
    last_sequences = {last_sequence - 1, last_sequence}
    deadline = time.monotonic() + LONG_S
    while time.monotonic() < deadline:
        found = await pointers(nc)
        last = [each.kept[0] for each in found if each.kept]
        if {each.sequence for each in last} == last_sequences and {each.format for each in last} == {file_format}:
            return found
        await asyncio.sleep(0.05)
    raise AssertionError(f"not saved: {await pointers(nc)}")


async def assert_bit_identical(nc: Client, registry: PackRegistry, blocks: int) -> list[Partition]:
    """Check that each pack's state is that of one run over all its blocks, and return the partitions."""
    partitions = await end_states(nc, registry, PARTITIONS)
    for pack in (*PACKS, *IDLE_PACKS):
        state = partitions[subjects.partition_of(pack, PARTITIONS)].state(pack)
        assert state is not None
        assert estimates_of(state["estimator"]) == estimated(registry, pack, blocks if pack in PACKS else 1)
    return list(partitions.values())


@pytest.mark.thorough
async def test_states_survive_a_rolling_upgrade_and_a_roll_back_while_blocks_arrive(nc, heartbeats, workers) -> None:
    registry = await load_packs(nc, PACKS + IDLE_PACKS)
    old = workers.start("old")
    await send_blocks(nc, 1)
    first_saved = await until_saved(nc, blocks=1, file_format=FORMAT)
    new = workers.start("new", TWO_FORMATS)
    await heartbeats.until_held(PARTITIONS, "old", "new")
    await send_blocks(nc, 2)
    saved = await until_saved(nc, blocks=2, file_format=FORMAT)  # the format that both versions read
    assert sorted(each.worker for each in saved) == ["new", "old"]
    old_partition = next(index for index, each in enumerate(saved) if each.worker == "old")
    assert any(each[old_partition].kept[0].increments for each in (first_saved, saved))
    assert await old.end() == 0
    await heartbeats.until_held(PARTITIONS, "new")
    await send_blocks(nc, 3)
    await until_saved(nc, blocks=3, file_format=TWO_FORMATS)

    old = workers.start("old-again")
    await until_saved(nc, blocks=3, file_format=FORMAT)  # although no block has arrived
    await heartbeats.until_held(PARTITIONS, "old-again", "new")
    await send_blocks(nc, 4)
    assert await new.end() == 0
    await heartbeats.until_held(PARTITIONS, "old-again")
    await send_blocks(nc, 5)
    await until_saved(nc, blocks=5, file_format=FORMAT)
    assert await old.end() == 0
    partitions = await assert_bit_identical(nc, registry, 5)
    assert all(each.counters[UPGRADED] and each.counters[DOWNGRADED] for each in partitions)


@pytest.mark.thorough
async def test_status_shows_the_builds_of_workers_by_their_commits(nc, heartbeats, workers, cluster, tmp_path) -> None:
    project, by_worker = link_project(tmp_path / "project"), {}
    for name in ("old", "new"):
        (by_worker[name],) = versions(project, "commit; version")
        build = tmp_path / name
        with zipfile.ZipFile(build_wheel(build, project)) as wheel:
            wheel.extractall(build)
        program = ("env", f"PYTHONPATH={build}", sys.executable, PROGRAM)
        workers.stack.callback(Process(tmp_path, cluster.url, name, program=program).kill)
    await heartbeats.until_held(PARTITIONS, *by_worker)
    async with running_program(PROGRAM, "fleet", "status", "--server", cluster.url) as process:
        out, _ = await process.communicate()
    rows = [line.split()[:2] for line in out.decode().splitlines()]
    assert [row for row in rows if row and row[0] in by_worker] == [[name, by_worker[name]] for name in ("new", "old")]
    assert by_worker["new"] != by_worker["old"]


@pytest.mark.thorough
async def test_worker_refuses_checkpoints_of_an_unreadable_format_until_the_right_version_takes_them(
    nc, heartbeats, workers, cluster, monkeypatch
) -> None:
    registry = await load_packs(nc, PACKS + IDLE_PACKS)
    later = workers.start("later", UNREADABLE_FORMAT)
    await send_blocks(nc, 1)
    saved = await until_saved(nc, blocks=1, file_format=UNREADABLE_FORMAT)
    later.kill()

    old = workers.start("old")
    await send_blocks(nc, 2)
    both = tuple(RefusedPartition(partition=number, format=UNREADABLE_FORMAT) for number in range(PARTITIONS))
    await heartbeats.until(lambda last: "old" in last and last["old"].refused == both)
    assert heartbeats.last["old"].partitions == ()
    await send_blocks(nc, 3)
    async with running_program(PROGRAM, "fleet", "status", "--server", cluster.url) as process:
        out, _ = await process.communicate()
    assert f"partition 1: old refuses it, because its checkpoint is of format {UNREADABLE_FORMAT}" in out.decode()
    assert await pointers(nc) == saved  # neither replaced nor claimed
    assert len([line for line in old.lines if "refused" in line["event"]]) == PARTITIONS

    workers.start("later-again", UNREADABLE_FORMAT)
    await heartbeats.until_held(PARTITIONS, "later-again")
    await until_saved(nc, blocks=3, file_format=UNREADABLE_FORMAT - 1)  # the oldest format that this version writes
    assert len(heartbeats.last["old"].refused) == PARTITIONS  # the old worker still runs
    later_version.set_format(UNREADABLE_FORMAT, monkeypatch.setattr)
    await assert_bit_identical(nc, registry, 3)
