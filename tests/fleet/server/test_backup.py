"""Backup of a server in use, restoration on another server, and rejected backups."""

import asyncio
import hashlib
import json
import stat
from collections.abc import Iterator
from contextlib import aclosing
from pathlib import Path

import numpy as np
import pytest
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.edge.block import decode, with_oldest
from bms_estimator.fleet.nats.stream_reader import read_stream
from bms_estimator.fleet.nats.stream_snapshot import read_info
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.server.backup import BACKUP_ORDER, back_up, restore
from bms_estimator.fleet.worker.checkpoint.claims import Claims
from bms_estimator.process.runtime import end_tasks
from tests.command_line import error, run
from tests.fleet.nats_cluster import NatsCluster, connected, running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import Heartbeats, Process, block, end_states, load_packs, record_of_run, samples, send, until
from tests.patience import LONG_S

PARTITIONS = 2
PACKS = ["p0", "p1", "p2"]
SEND_S = 0.02
"""Interval between two blocks of a pack [s]."""
MORE = 20
"""Number of blocks of each pack after those in the backup."""
FORGOTTEN = 5
"""Number of blocks after the backup that the edge of ``p1`` has deleted, because a worker confirmed them."""


def ignore(_line: str) -> None:
    """Ignore a progress line."""


async def numbers(nc: Client, pack: str) -> list[int]:
    """Return the numbers of a pack's blocks in the stream ``RAW``."""
    subject = subjects.stored_raw(subjects.partition_of(pack, PARTITIONS), pack)
    async with aclosing(read_stream(nc, subjects.RAW_STREAM, subject)) as batches:
        return [decode(message.data).number async for batch in batches for message in batch]


@pytest.mark.thorough
async def test_worker_continues_after_a_restoration_as_if_only_blocks_that_no_edge_has_were_missing(
    tmp_path: Path,
) -> None:
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
    with (
        running(tmp_path / "old", partitions=PARTITIONS) as old,
        running(tmp_path / "new", partitions=PARTITIONS) as new,
    ):
        nc = await connected(old.url)
        await make_streams(nc, partitions=PARTITIONS)
        registry = await load_packs(nc, PACKS)
        worker = Process(tmp_path, old.url, "before", "--checkpoint-s", 1)
        try:
            await worker.logged("ready")
            await back_up_while_blocks_arrive(nc, tmp_path / "backup")
        finally:
            worker.kill()
        sent = await numbers(nc, "p0")
        await nc.close()
        old.kill(0)

        nc = await connected(new.url)
        await make_streams(nc, partitions=PARTITIONS)
        await restore(nc, tmp_path / "backup", ignore)
        stored = {pack: await numbers(nc, pack) for pack in PACKS}
        assert all(stored[pack] == list(range(1, len(stored[pack]) + 1)) for pack in PACKS)
        assert 0 < len(stored["p0"]) < sent[-1], "the backup ends while blocks arrive"
        assert await checkpoint_sequences(nc), "no checkpoint was restored"
        worker = Process(tmp_path, new.url, "after", "--checkpoint-s", 1)
        oldest = {pack: len(stored[pack]) + 1 for pack in PACKS}
        last = {pack: len(stored[pack]) + MORE for pack in PACKS}
        oldest["p1"] += FORGOTTEN
        try:
            async with Heartbeats(nc) as heartbeats:
                for pack in PACKS:
                    for number in range(oldest[pack], last[pack] + 1):
                        await send(nc, pack, with_oldest(block(pack, number), oldest[pack]))
                total = sum(last.values()) - FORGOTTEN
                await heartbeats.until(
                    lambda seen: "after" in seen and seen["after"].counters.get("blocks", 0) == total
                )
            assert await worker.end() == 0
        finally:
            worker.kill()
        states = await end_states(nc, registry, PARTITIONS)
        for pack in PACKS:
            state = states[subjects.partition_of(pack, PARTITIONS)].state(pack)
            lost = FORGOTTEN if pack == "p1" else 0
            assert (state["delivery"]["awaited"][0], state["delivery"]["lost_blocks"][0]) == (last[pack] + 1, lost)
            processed = [*stored[pack], *range(oldest[pack], last[pack] + 1)]
            rows = np.concatenate([samples(pack, number) for number in processed])
            assert estimates_of(state["estimator"]) == record_of_run(registry, pack, rows)
        await nc.close()


async def back_up_while_blocks_arrive(nc: Client, folder: Path) -> None:
    """Make a backup after the first checkpoints, while blocks of all packs arrive."""
    number = 0

    async def send_blocks() -> None:
        nonlocal number
        while True:
            number += 1
            await asyncio.gather(*(send(nc, pack, block(pack, number)) for pack in PACKS))
            await asyncio.sleep(SEND_S)

    sending = asyncio.create_task(send_blocks())
    try:
        async with asyncio.timeout(LONG_S):
            while len(await checkpoint_sequences(nc)) < PARTITIONS:  # noqa: ASYNC110 - a worker sends no notification
                await asyncio.sleep(SEND_S)
        await back_up(nc, folder, [], ignore)
        before = number
        await until(lambda: number >= before + 2, lambda: number)
    finally:
        await end_tasks(sending)


async def checkpoint_sequences(nc: Client) -> list[int]:
    """Return the sequence numbers of the last checkpoints of the partitions that have one."""
    js = nc.jetstream(timeout=LONG_S)
    claims = Claims("test", await js.key_value(subjects.CHECKPOINTS_BUCKET))
    pointers = [await claims.read(number) for number in range(PARTITIONS)]
    return [stored.pointer.kept[0].sequence for stored in pointers if stored and stored.pointer.kept]


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[NatsCluster, NatsCluster]]:
    """Run a server with two blocks and a new server, both with streams."""
    folders = [tmp_path_factory.mktemp(name) for name in ("used", "new")]
    with running(folders[0], partitions=PARTITIONS) as used, running(folders[1], partitions=PARTITIONS) as new:
        for server, blocks in ((used, 2), (new, 0)):
            asyncio.run(prepare(server.url, blocks))
        yield used, new


async def prepare(url: str, blocks: int) -> None:
    """Create the streams of a server, and send blocks."""
    nc = await connected(url)
    await make_streams(nc, partitions=PARTITIONS)
    for number in range(blocks):
        await send(nc, "p0", block("p0", number + 1))
    await nc.close()


async def last_sequences(url: str) -> dict[str, int]:
    """Return the last sequence number of each stream of the fleet."""
    nc = await connected(url)
    try:
        return {name: (await read_info(nc, name)).state["last_seq"] for name in BACKUP_ORDER}
    finally:
        await nc.close()


@pytest.fixture
def backup(servers: tuple[NatsCluster, NatsCluster], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """Make a backup of the used server with settings and keys."""
    keys = tmp_path / "keys"
    (keys / "acme").mkdir(parents=True)
    (keys / "acme" / "account.nk").write_bytes(b"secret")
    (tmp_path / "fleet.toml").write_text("[server]\n")
    include = ["--include", keys, "--include", tmp_path / "fleet.toml"]
    code, out, _ = run(capsys, "fleet", "backup", tmp_path / "backup", "--server", servers[0].url, *include)
    assert code == 0
    assert "RAW: 2 messages" in out
    return tmp_path / "backup"


def test_backup_has_private_copies_of_keys_and_settings(backup: Path) -> None:
    assert (backup / "files" / "keys" / "acme" / "account.nk").read_bytes() == b"secret"
    assert (backup / "files" / "fleet.toml").read_text() == "[server]\n"
    modes = {stat.S_IMODE(path.stat().st_mode) for path in backup.rglob("*") if path.is_file()}
    assert modes == {0o600}
    assert {stat.S_IMODE(path.stat().st_mode) for path in (backup, *backup.rglob("*")) if path.is_dir()} == {0o700}


async def test_backup_includes_all_streams_except_requests_that_workers_repeat(
    servers: tuple[NatsCluster, NatsCluster],
) -> None:
    nc = await connected(servers[0].url)
    response = await nc.request("$JS.API.STREAM.NAMES", timeout=LONG_S)
    assert set(json.loads(response.data)["streams"]) == {*BACKUP_ORDER, subjects.FITS_STREAM}
    await nc.close()


def edit_list(backup: Path, **fields: object) -> None:
    file = backup / "backup.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | fields))


def damage_snapshot(backup: Path) -> None:
    """Change one byte in the middle of the snapshot of ``RAW``."""
    file = backup / "streams" / "RAW"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def edit_raw(backup: Path, part: str, **fields: object) -> None:
    """Change fields of the configuration or of the state of ``RAW``."""
    streams = json.loads((backup / "backup.json").read_text())["streams"]
    streams["RAW"][part] |= fields
    edit_list(backup, streams=streams)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (damage_snapshot, "streams/RAW: does not match its digest: the backup is damaged"),
        (lambda backup: (backup / "streams" / "DEAD").unlink(), "streams/DEAD: cannot be read: No such file"),
        (lambda backup: (backup / "files" / "fleet.toml").write_text("["), "fleet.toml: has 1 bytes instead of 9"),
        (lambda backup: (backup / "backup.json").unlink(), "no complete backup, because backup.json is missing"),
        (lambda backup: edit_list(backup, version=2), "backup.json: version: Input should be 1"),
        (lambda backup: edit_list(backup, streams={}), "the backup lacks DEAD, HISTORY, HOURS, KV_cells"),
        (lambda backup: edit_list(backup, partitions=8), "the backup has 8 partitions, the server 2"),
        (lambda backup: edit_raw(backup, "config", num_replicas=3), "RAW: the backup has 3 copies, the server 1"),
        (lambda backup: edit_raw(backup, "state", bytes=10**18), "RAW: the backup has 1,000,000,000,000,000,000 bytes"),
    ],
)
def test_invalid_backup_is_refused_and_the_server_is_unchanged(
    change, reason: str, backup: Path, servers: tuple[NatsCluster, NatsCluster], capsys: pytest.CaptureFixture[str]
) -> None:
    change(backup)
    assert reason in error(run(capsys, "fleet", "restore", backup, "--server", servers[1].url))
    assert asyncio.run(last_sequences(servers[1].url)) == dict.fromkeys(BACKUP_ORDER, 0)


def test_server_with_data_is_not_overwritten(
    backup: Path, servers: tuple[NatsCluster, NatsCluster], capsys: pytest.CaptureFixture[str]
) -> None:
    err = error(run(capsys, "fleet", "restore", backup, "--server", servers[0].url))
    assert "the server already has data, in RAW: restore on a new server" in err
    assert asyncio.run(last_sequences(servers[0].url))["RAW"] == 2


def test_backup_into_a_folder_with_files_is_refused(
    backup: Path, servers: tuple[NatsCluster, NatsCluster], capsys: pytest.CaptureFixture[str]
) -> None:
    before = (backup / "backup.json").read_bytes()
    err = error(run(capsys, "fleet", "backup", backup, "--server", servers[0].url))
    assert "is not empty: choose a new folder for each backup" in err
    assert (backup / "backup.json").read_bytes() == before


def test_streams_that_the_server_rejects_are_removed_again_so_that_a_later_restoration_succeeds(
    backup: Path, servers: tuple[NatsCluster, NatsCluster], capsys: pytest.CaptureFixture[str]
) -> None:
    url = servers[1].url
    intact = (backup / "streams" / "RAW").read_bytes(), (backup / "backup.json").read_text()
    damage_snapshot(backup)
    files = json.loads(intact[1])["files"]
    digest = hashlib.sha256((backup / "streams" / "RAW").read_bytes()).hexdigest()
    edit_list(backup, files=files | {"streams/RAW": files["streams/RAW"] | {"sha256": digest}})
    code, out, err = run(capsys, "fleet", "restore", backup, "--server", url)
    assert code == 2
    assert "RAW: the server rejects the request: restore failed" in err
    assert "not restored: restart `fleet serve`" in out
    asyncio.run(prepare(url, 0))
    assert asyncio.run(last_sequences(url)) == dict.fromkeys(BACKUP_ORDER, 0)
    (backup / "streams" / "RAW").write_bytes(intact[0])
    (backup / "backup.json").write_text(intact[1])
    assert run(capsys, "fleet", "restore", backup, "--server", url)[0] == 0
    assert asyncio.run(last_sequences(url))["RAW"] == 2
