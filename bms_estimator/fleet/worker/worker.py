"""Worker process, which processes its share of the partitions on one connection."""

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js.errors import NotFoundError
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import DEAD_S, HEARTBEAT_S, Heartbeat
from bms_estimator.fleet.nats.connection import (
    RETRYABLE_ERRORS,
    close,
    connect,
    error_text,
    raise_if_closed,
    retry_until_ready,
)
from bms_estimator.fleet.nats.streams import require_partitions
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.worker.block_loop import BlockLoop
from bms_estimator.fleet.worker.block_runner import Totals
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import UnreadableFormatError
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore, open_checkpoints
from bms_estimator.fleet.worker.heartbeat_report import HeartbeatReport
from bms_estimator.fleet.worker.lease_tasks import LeaseTasks, PeriodicStorage, UnknownPacks, UnsavedCheck
from bms_estimator.fleet.worker.membership import Membership
from bms_estimator.fleet.worker.partition_lease import PartitionLease
from bms_estimator.fleet.worker.pinned_consumer import RENEW_S
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import end_tasks, result_before, until_first_ends
from bms_estimator.process.systemd import SystemdNotifier

CHECKPOINT_S = 300.0
"""Default interval between two checkpoints of a partition [s]."""
DISCOVERY_S = 0.5
"""Time for discovering other workers before partitions are claimed [s]. They respond to a new worker's heartbeat at
once."""
CHECK_S = 0.5
"""Interval between two checks for a due checkpoint or waiting summaries [s]."""
REFUSAL_CHECK_S = 10.0
"""Poll interval for a readable checkpoint of a refused partition [s]."""
UNSAVED_CHECK_S = 30.0
"""Interval between two runs of ``UnsavedCheck`` [s]."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Options:
    """Options of a worker.

    Attributes:
        servers, creds, ca: Arguments of ``connect``.
        name: Name of the worker.
        checkpoint_s: Interval between checkpoints of a partition [s].
    """

    servers: str
    name: str
    creds: Path | None = None
    ca: Path | None = None
    checkpoint_s: float = CHECKPOINT_S


async def work(options: Options, stop: asyncio.Event) -> None:
    """Run a worker until ``stop`` is set; then save checkpoints and release the partitions.

    Raises:
        UserError: An option cannot be used, or the server has closed the connection permanently.
    """
    notifier = SystemdNotifier([options.name])
    worker = await result_before(stop, _start(options, notifier))
    if worker is None:
        return
    try:
        await until_first_ends(worker.run(), stop.wait())
    finally:
        notifier.stopping(options.name)
        await worker.end()


async def _start(options: Options, notifier: SystemdNotifier) -> "Worker":
    """Connect and create a worker; repeat until the server has the streams."""
    nc = await connect(options.servers, options.name, creds=options.creds, ca=options.ca)
    stores = await retry_until_ready(nc, options.servers, lambda: open_stores(nc, options.name))
    return Worker(nc, options, stores, notifier)


async def open_stores(nc: Client, worker: str) -> tuple[int, CheckpointStore, PackBucket]:
    """Return the number of partitions, the store of the checkpoints, and the table of packs, after reading it.

    Args:
        nc: Connection to the tenant's NATS account.
        worker: Name of the worker.

    Raises:
        UserError: A stream is missing.
    """
    partitions = await require_partitions(nc)
    try:
        await nc.jetstream().stream_info(subjects.FITS_STREAM)
    except NotFoundError:
        raise UserError(
            f"the server has no stream {subjects.FITS_STREAM}: upgrade and restart `bms-estimator fleet serve` before the workers"
        ) from None
    checkpoints = await open_checkpoints(nc, worker)
    bucket = PackBucket(nc)
    await bucket.refresh()
    return partitions, checkpoints, bucket


class Worker:
    """Worker process, and the leases of its partitions.

    Args:
        nc: Connection to the tenant's NATS account.
        options: Options of the worker.
        stores: Result of ``open_stores``.
        notifier: Notifies systemd that the worker is ready, alive or stopping.
    """

    def __init__(
        self, nc: Client, options: Options, stores: tuple[int, CheckpointStore, PackBucket], notifier: SystemdNotifier
    ) -> None:
        self._nc, self._options, self._notifier = nc, options, notifier
        self._partitions, self._checkpoints, self._bucket = stores
        self._members = Membership(options.name)
        self._inbox = nc.new_inbox()
        self._changed_packs: asyncio.Queue[set[str]] = asyncio.Queue()
        self._leases_updated_s = time.monotonic()
        self._leaving = False
        self._block_loop = BlockLoop()
        self._unknown = UnknownPacks(nc, self._bucket.packs)
        self._totals = Totals()
        self._report = HeartbeatReport(options.name, self._totals)
        self._lease_tasks = LeaseTasks(lambda: nc.is_connected)
        self._storage = PeriodicStorage(nc, options.checkpoint_s, self._partitions)
        self._unsaved = UnsavedCheck(nc)

    async def run(self) -> None:
        """Claim and process partitions until cancelled.

        Raises:
            UserError: The server has closed the connection permanently.
        """
        await self._nc.subscribe(subjects.worker(), cb=self._receive_heartbeat)
        await self._nc.subscribe(f"{self._inbox}.*.*", cb=self._receive)
        await self._send_heartbeat()
        await asyncio.sleep(DISCOVERY_S)
        self._notifier.ready(self._options.name)
        log.info("ready", worker=self._options.name, partitions=self._partitions)
        await until_first_ends(
            _repeat(HEARTBEAT_S, self._send_heartbeat),
            _repeat(RENEW_S, self._update_leases),
            _repeat(CHECK_S, lambda: self._storage.save(self._leases)),
            _repeat(CHECK_S, lambda: self._storage.send_results(self._leases)),
            _repeat(REFUSAL_CHECK_S, self._check_refused),
            _repeat(
                UNSAVED_CHECK_S, lambda: self._unsaved.run([lease.number for lease in self._leases if lease.is_owned])
            ),
            self._bucket.follow(self._changed_packs.put_nowait),
            self._apply_table_changes(),
            self._block_loop.run(),
        )

    async def end(self) -> None:
        """Save checkpoints, release the partitions, and close the connection."""
        self._leaving = True
        await self._send_heartbeat()  # with ``leaving``, so that other workers request the partitions from now on
        if not self._nc.is_connected:
            log.warning(
                "no connection to the server: the next owners of the partitions read the stream from the last checkpoints"
            )
        # a pin expires without requests: continue them until each consumer is released
        renewing = asyncio.ensure_future(_repeat(RENEW_S, self._send_requests))
        await self._lease_tasks.release_all()
        await end_tasks(renewing)
        await close(self._nc)

    @property
    def _leases(self) -> list[PartitionLease]:
        return self._lease_tasks.leases

    async def _receive_heartbeat(self, message: Msg) -> None:
        """Process another worker's heartbeat; answer the first one of a new worker."""
        try:
            heartbeat = Heartbeat.model_validate_json(message.data)
        except ValidationError as error:
            log.warning("invalid heartbeat of a worker", subject=message.subject, reason=str(error.errors()[0]["msg"]))
            return
        if (
            heartbeat.id == self._options.name
            and heartbeat.started_s != self._report.started_s
            and not heartbeat.leaving
        ):
            log.warning("another worker has the same name: give each worker a different --name", worker=heartbeat.id)
        now_s = time.monotonic()
        if self._members.on_heartbeat(heartbeat, now_s):
            log.info("new worker", worker=heartbeat.id)
            await self._send_heartbeat()

    async def _receive(self, message: Msg) -> None:
        """Pass a message or status to the lease of its partition.

        Messages arrive on the stream's subject p.<partition>.raw.<pack>, statuses on <inbox>.<partition>.<pin>.
        """
        tokens = message.subject.split(".")
        lease = self._lease_tasks.get(int(tokens[-2] if message.subject.startswith(self._inbox) else tokens[1]))
        if lease:
            lease.receive(message)

    async def _send_heartbeat(self) -> None:
        """Publish the heartbeat and the unknown packs, and notify systemd."""
        if self._nc.is_connected:
            heartbeat = self._heartbeat()
            await self._nc.publish(subjects.worker(self._options.name), heartbeat.model_dump_json().encode())
            await self._unknown.publish(self._leases)
        self._notifier.alive(self._options.name)

    async def _update_leases(self) -> None:
        """Claim assigned partitions, release the others, and request more messages."""
        raise_if_closed(self._nc, self._options.servers)
        now_s = time.monotonic()
        # without a connection no heartbeat arrives, and while the event loop was blocked none was read
        if not self._nc.is_connected or now_s > self._leases_updated_s + DEAD_S / 2.0:
            self._members.extend_deadlines(now_s)
        self._leases_updated_s = now_s
        await self._refuse_unreadable()
        share = self._members.share(self._partitions, now_s)
        for number in self._lease_tasks.numbers - share:
            self._lease_tasks.start_release(number)
        for number in sorted(share - self._lease_tasks.numbers):
            self._lease_tasks.start(self._make_lease(number, now_s))
        self._lease_tasks.raise_internal_errors()
        await self._send_requests()
        if self._nc.is_connected:
            for lease in self._leases:
                lease.check_silence()

    async def _refuse_unreadable(self) -> None:
        """Record the partitions whose checkpoints cannot be read, and announce them, so that other workers claim them."""
        refused = {lease.number: lease.refused_format for lease in self._leases if lease.refused_format is not None}
        if refused.keys() - self._members.refused.keys():
            self._members.refused |= refused
            await self._send_heartbeat()

    async def _check_refused(self) -> None:
        """Stop refusing the partitions whose last checkpoints another worker has since written in a readable format."""
        refused = self._members.refused
        for number in refused.keys() - self._lease_tasks.numbers if self._nc.is_connected else ():
            try:
                await self._checkpoints.claims.check_format(number)
            except UnreadableFormatError as error:
                refused[number] = error.format
            except RETRYABLE_ERRORS as error:
                log.warning("a refused partition cannot be checked", partition=number, reason=error_text(error))
            else:
                log.info("the checkpoint of a refused partition has become readable", partition=number)
                del refused[number]

    async def _send_requests(self) -> None:
        if self._nc.is_connected:
            for lease in self._leases:
                await lease.consumer.renew()

    def _make_lease(self, number: int, now_s: float) -> PartitionLease:
        lease = PartitionLease(
            self._nc,
            number,
            self._bucket.packs,
            self._checkpoints,
            self._inbox,
            self._block_loop,
            self._totals,
            partitions=self._partitions,
            checkpoint_format=lambda: self._members.checkpoint_format(time.monotonic()),
            sources=self._bucket.packs,
            is_busy=lambda: any(each.consumer.waiting for each in self._leases),
        )
        lease.checkpoint_due_s = self._storage.first_due_s(number, now_s)
        return lease

    async def _apply_table_changes(self) -> None:
        """Notify partitions of changed and new rows of the table of packs."""
        while True:
            for pack in await self._changed_packs.get():
                lease = self._lease_tasks.get(subjects.partition_of(pack, self._partitions))
                if lease:
                    lease.on_settings_changed(pack)

    def _heartbeat(self) -> Heartbeat:
        waiting = (lease.trouble for lease in self._leases if lease.trouble)
        storage = (trouble for lease in self._leases for trouble in lease.storage_troubles.values())
        return self._report.make(
            self._leases,
            self._members.refused_partitions(),
            leaving=self._leaving,
            reconnects=self._nc.stats["reconnects"],
            checkpoint_s=self._storage.checkpoint_s,
            trouble=next(itertools.chain(waiting, storage), self._bucket.fault or self._unsaved.warning),
        )


async def _repeat(period_s: float, action: Callable[[], Awaitable[None]]) -> None:
    """Call ``action`` periodically until cancelled. Missed calls are not repeated."""
    while True:
        await action()
        await asyncio.sleep(period_s)
