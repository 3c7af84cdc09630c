"""Backup of a tenant's streams while they are in use, and restoration on a new server.

The server takes the snapshots of the streams one after another, while workers and edges continue. ``BACKUP_ORDER`` makes the
snapshots consistent:

- The pointers to the checkpoints come before the checkpoints, because a worker writes a checkpoint before the pointer to it. A
  pointer names the last two checkpoints and the first one of the day. If a worker replaces the last two during the backup, the
  first one of the day remains.
- ``RAW`` comes after the checkpoints, so that it has the messages that follow each checkpoint.
  ``HOURS``, ``DEAD`` and ``HISTORY`` also come after the checkpoints, because a worker sends to them before it writes a
  checkpoint.
- The table comes after ``RAW``, so that it has a row for each pack in ``RAW``. Rows come before the cell files that they name.

The stream ``TELEMETRY`` of ``fleet ingest`` is not part of a backup, because a batch waits there only until ``fleet ingest`` has
its samples in blocks on its own disk. ``FITS`` is not part of it, because workers repeat unanswered requests.
"""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_snapshot import (
    RESPONSE_TIMEOUT_S,
    StreamInfo,
    read_info,
    read_snapshot,
    restore_stream,
)
from bms_estimator.fleet.nats.streams import PARTITIONS_KEY
from bms_estimator.fleet.server.backup_files import (
    BackupList,
    FileWriter,
    copy_files,
    make_folder,
    read_chunks,
    read_list,
    snapshot_path,
    write_list,
)
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.errors import UserError
from bms_estimator.version import __version__

BACKUP_ORDER = (
    f"KV_{subjects.CHECKPOINTS_BUCKET}",
    f"OBJ_{subjects.STATES_BUCKET}",
    subjects.HOURS_STREAM,
    subjects.DEAD_STREAM,
    subjects.HISTORY_STREAM,
    subjects.RAW_STREAM,
    f"KV_{subjects.PACKS_BUCKET}",
    f"KV_{subjects.CELLS_BUCKET}",
)
"""Names of the streams in a backup, in the order of their snapshots."""
RESTORE_ORDER = (*(name for name in BACKUP_ORDER if name != subjects.RAW_STREAM), subjects.RAW_STREAM)
"""Names of the streams in the order of their restoration. ``RAW`` is the last one, because a worker waits until it exists."""


async def back_up(nc: Client, folder: Path, include: list[Path], report: Callable[[str], None]) -> None:
    """Write a backup of the tenant's streams.

    Args:
        nc: Connection to the tenant's NATS account, with its administrator's permissions.
        folder: Folder of the backup; must be empty or not exist.
        include: Further files and folders that are copied, such as settings and keys.
        report: Receives a line for each stream.

    Raises:
        UserError: A file cannot be read or written.
        StreamError: The server does not respond, or has no such stream.
    """
    made = iso_utc(time.time())
    make_folder(folder)
    digests, streams = copy_files(include, folder), dict[str, StreamInfo]()
    for name in BACKUP_ORDER:
        path = snapshot_path(name)
        try:
            with FileWriter(folder / path) as file:
                streams[name] = await read_snapshot(nc, name, file.write)
                digests[path] = file.sync()
        except OSError as error:
            raise UserError(f"{folder / path}: cannot be written: {error.strerror}") from None
        report(f"{name}: {streams[name].state['messages']:,} messages, {digests[path].bytes:,} bytes")
    backup = BackupList(
        made=made,
        program=__version__,
        partitions=_partitions(streams[subjects.RAW_STREAM].config),
        streams=streams,
        files=digests,
    )
    write_list(folder, backup)


async def restore(nc: Client, folder: Path, report: Callable[[str], None]) -> None:
    """Restore the tenant's streams from a backup on a server whose streams have never had a message.

    The streams get the configuration of the new server: sizes and number of replicas.

    Args:
        nc: Connection to the tenant's NATS account, with its administrator's permissions.
        folder: Folder of the backup.
        report: Receives a line for each stream.

    Raises:
        UserError: The backup is incomplete or damaged, or the server's streams have data or do not fit. Nothing was changed.
        StreamError: The server does not respond, or rejects a stream.
    """
    backup = read_list(folder)
    configs = await _configs_of_empty_streams(nc)
    _check_restorable(backup, configs)
    try:
        await _delete_streams(nc)
        for name in RESTORE_ORDER:
            snapshot = backup.streams[name]
            new = StreamInfo(config=configs[name], state=snapshot.state)
            await restore_stream(nc, new, read_chunks(folder / snapshot_path(name)))
            report(f"{name}: {snapshot.state['messages']:,} messages")
    except BaseException:
        await _delete_streams(nc)
        report("not restored: restart `fleet serve`, which creates empty streams, before the next attempt")
        raise


async def _delete_streams(nc: Client) -> None:
    js = nc.jetstream(timeout=RESPONSE_TIMEOUT_S)
    for name in BACKUP_ORDER:
        with contextlib.suppress(NotFoundError):
            await js.delete_stream(name)


async def _configs_of_empty_streams(nc: Client) -> dict[str, dict[str, Any]]:
    """Return the configurations of the streams, which have never had a message.

    Raises:
        UserError: A stream has, or has had, messages.
    """
    infos = {name: await read_info(nc, name) for name in BACKUP_ORDER}
    if used := [name for name, info in infos.items() if info.state["last_seq"]]:
        raise UserError(
            f"the server already has data, in {', '.join(used)}: restore on a new server, before workers and edges connect"
        )
    return {name: info.config for name, info in infos.items()}


def _check_restorable(backup: BackupList, configs: dict[str, dict[str, Any]]) -> None:
    """Check that the streams of a backup can be restored with the configurations of the new server.

    Raises:
        UserError: A stream is missing, has another number of partitions or more replicas, or is too large.
    """
    if missing := set(BACKUP_ORDER) - backup.streams.keys():
        raise UserError(
            f"the backup lacks {', '.join(sorted(missing))}: restore it with version {backup.program} of this program"
        )
    partitions = _partitions(configs[subjects.RAW_STREAM])
    if backup.partitions != partitions:
        raise UserError(
            f"the backup has {backup.partitions} partitions, the server {partitions}: "
            f"set server.partitions = {backup.partitions}, and start the server with an empty folder"
        )
    for name, snapshot in backup.streams.items():
        replicas, server_replicas = (int(config["num_replicas"]) for config in (snapshot.config, configs[name]))
        if replicas > server_replicas:  # the server would reject the consumers of the backup
            raise UserError(
                f"{name}: the backup has {replicas} copies, the server {server_replicas}: restore it on three nodes"
            )
        limit = configs[name].get("max_bytes", -1)
        if 0 < limit < snapshot.state["bytes"]:
            raise UserError(
                f"{name}: the backup has {snapshot.state['bytes']:,} bytes, the server's limit is {limit:,}: "
                "increase packs or outage_days of the server"
            )


def _partitions(raw_config: dict[str, Any]) -> int:
    return int((raw_config.get("metadata") or {}).get(PARTITIONS_KEY, subjects.PARTITIONS))
