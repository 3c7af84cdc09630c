"""A worker: as many partitions as are its share of what there is, on one connection."""

import asyncio
import resource
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import DEAD_S, HEARTBEAT_S, Heartbeat
from bms_estimator.fleet.nats.connection import connect, error_text, part
from bms_estimator.fleet.nats.streams import partitions_of
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.worker.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.membership import Membership
from bms_estimator.fleet.worker.partition_lease import RETRY_S, TROUBLES, PartitionLease
from bms_estimator.fleet.worker.pinned_consumer import RENEW_S
from bms_estimator.model.errors import UserError
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.process.tasks import end, until_first_ends

CHECKPOINT_S = 300.0
"""Default interval between two checkpoints of a partition [s]."""
LISTEN_S = 0.5
"""Time of listening to other workers before partitions are claimed [s]: they answer a new worker at once."""
LOOK_S = 0.5
"""Interval between two checks for a due checkpoint or waiting summaries [s]."""
MAX_UNKNOWN = 20
"""Packs that a heartbeat names."""
AT_ONCE = 8
"""Partitions that are given back at the same time."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Options:
    """Options of a worker.

    Attributes:
        servers: As ``connect`` has them, like ``creds`` and ``ca``.
        name: Name of the worker.
        checkpoint_s: Interval between checkpoints of a partition [s].
    """

    servers: str
    name: str
    creds: Path | None = None
    ca: Path | None = None
    checkpoint_s: float = CHECKPOINT_S


async def work(options: Options, stop: asyncio.Event) -> None:
    """Work until ``stop`` is set; then save checkpoints and release the partitions.

    Raises:
        UserError: An option cannot be used, or the server has closed the connection permanently.
    """
    notifier = SystemdNotifier([options.name])
    starting = asyncio.ensure_future(_start(options, notifier))
    await until_first_ends(asyncio.wait([starting]), stop.wait())
    if not starting.done():
        await end(starting)
        return
    worker = starting.result()
    try:
        await until_first_ends(worker.run(), stop.wait())
    finally:
        notifier.stopping(options.name)
        await worker.end()


async def _start(options: Options, notifier: SystemdNotifier) -> "Worker":
    """Connect, and find the streams; tried until it works."""
    nc = await connect(options.servers, options.name, creds=options.creds, ca=options.ca)
    said = ""
    while True:
        try:
            return await _found(nc, options, notifier)
        except (*TROUBLES, UserError) as error:
            _check(nc, options)
            if (text := error_text(error)) != said:
                log.warning("waiting for the server", reason=text)
            said = text
        await asyncio.sleep(RETRY_S)


def _check(nc: Client, options: Options) -> None:
    """Check that the connection can be restored.

    Raises:
        UserError: The server has closed it permanently.
    """
    if nc.is_closed:
        raise UserError(f"the server {options.servers} has closed the connection: look at --creds")


async def _found(nc: Client, options: Options, notifier: SystemdNotifier) -> "Worker":
    partitions = await partitions_of(nc)
    if partitions is None:
        raise UserError(f"the server has no stream {subjects.RAW_STREAM}: make it with `bms-estimator fleet serve`")
    js = nc.jetstream()
    checkpoints = await js.key_value(subjects.CHECKPOINTS_BUCKET)
    states = await js.object_store(subjects.STATES_BUCKET)
    bucket = PackBucket(nc)
    await bucket.refresh()
    keeping = CheckpointStore(nc, options.name, checkpoints, states)
    return Worker(nc, options, partitions, keeping, bucket, notifier)


class Worker:
    """The partitions of one process.

    Args:
        nc: Connected.
        options: Options of the worker.
        partitions: Total number of partitions.
        keeping: Store of the checkpoints.
        bucket: The table of packs.
        notifier: Is notified that the worker is ready and alive.
    """

    def __init__(
        self,
        nc: Client,
        options: Options,
        partitions: int,
        keeping: CheckpointStore,
        bucket: PackBucket,
        notifier: SystemdNotifier,
    ) -> None:
        self._nc, self._options, self._partitions = nc, options, partitions
        self._keeping, self._bucket, self._notifier = keeping, bucket, notifier
        self._members = Membership(options.name)
        self._inbox = nc.new_inbox()
        self._held: dict[int, tuple[PartitionLease, asyncio.Task[None]]] = {}
        self._returning: dict[int, asyncio.Task[None]] = {}
        self._changed: asyncio.Queue[set[str]] = asyncio.Queue()
        self._started_s = time.time()
        self._renewed_s = time.monotonic()
        self._blocks = self._samples = self._faults = 0  # of partitions that were given back
        self._leaving = False
        self._turn = asyncio.Lock()
        self._few = asyncio.Semaphore(AT_ONCE)
        self._told: set[str] = set()

    async def run(self) -> None:
        """Run until it is cancelled.

        Raises:
            UserError: The server has closed the connection permanently.
        """
        await self._nc.subscribe(subjects.worker(), cb=self._receive_heartbeat)
        await self._nc.subscribe(f"{self._inbox}.*.*", cb=self._receive)
        await self._beat()
        await asyncio.sleep(LISTEN_S)
        self._notifier.ready(self._options.name)
        log.info("ready", worker=self._options.name, partitions=self._partitions)
        await until_first_ends(
            _each(HEARTBEAT_S, self._beat),
            _each(RENEW_S, self._renew),
            _each(LOOK_S, self._save),
            _each(LOOK_S, self._send_hours),
            self._bucket.follow(self._changed.put_nowait),
            self._settle(),
        )

    async def end(self) -> None:
        """Keep all states, give the partitions back, and close the connection."""
        self._leaving = True
        await self._beat()  # others ask for the partitions from now on
        if not self._nc.is_connected:
            log.warning("the server is away: who has the partitions next reads the stream from the last checkpoints")
        for number in list(self._held):
            self._give_back(number)
        renewing = asyncio.ensure_future(_each(RENEW_S, self._ask_all))
        await asyncio.gather(*self._returning.values())
        await end(renewing)
        await part(self._nc)

    @property
    def _holdings(self) -> list[PartitionLease]:
        return [holding for holding, _ in self._held.values()]

    async def _receive_heartbeat(self, message: Msg) -> None:
        try:
            heard = Heartbeat.model_validate_json(message.data)
        except ValidationError as error:
            log.warning(
                "this is no heartbeat of a worker", subject=message.subject, reason=str(error.errors()[0]["msg"])
            )
            return
        if heard.id == self._options.name and heard.started_s != self._started_s and not heard.leaving:
            log.warning("another worker has the same name: give each its own with --name", worker=heard.id)
        now_s = time.monotonic()
        if self._members.on_heartbeat(heard.id, now_s, leaving=heard.leaving):
            log.info("another worker", worker=heard.id)
            await self._beat()

    async def _receive(self, message: Msg) -> None:
        """Messages arrive on the stream's subject, p.<partition>.raw.<pack>.

        Statuses on the inbox, <inbox>.<partition>.<pin>.
        """
        tokens = message.subject.split(".")
        found = self._held.get(int(tokens[-2] if message.subject.startswith(self._inbox) else tokens[1]))
        if found:
            found[0].receive(message)

    async def _beat(self) -> None:
        """Publish the heartbeat."""
        if self._nc.is_connected:
            heartbeat = self._heartbeat()
            await self._nc.publish(subjects.worker(self._options.name), heartbeat.model_dump_json().encode())
            await self._publish_unknown()
        self._notifier.alive(self._options.name)

    async def _publish_unknown(self) -> None:
        """Publish once for each unknown pack that the table lacks it, with the reason."""
        unknown = {pack for holding in self._holdings if holding.partition for pack in holding.partition.unknown}
        for pack in unknown - self._told:
            why = self._bucket.packs.reason(pack)
            log.warning("unknown pack: its blocks are held", pack=pack, reason=why)
            await self._nc.publish(subjects.unknown(pack), why.encode())
        self._told = unknown

    async def _renew(self) -> None:
        """Claim assigned partitions, release others, and request more messages."""
        _check(self._nc, self._options)
        now_s = time.monotonic()
        if not self._nc.is_connected or now_s > self._renewed_s + DEAD_S / 2.0:
            self._members.extend_all(now_s)  # no other worker could be received
        self._renewed_s = now_s
        share = self._members.share(self._partitions, now_s)
        for number in self._held.keys() - share:
            self._give_back(number)
        for number in sorted(share - self._held.keys()):
            self._try_for(number, now_s)
        for task in [*self._returning.values(), *(task for _, task in self._held.values())]:
            if task.done() and not task.cancelled():
                task.result()  # our own fault; unnoticed it would leave the partition without an owner
        await self._ask_all()
        if self._nc.is_connected:
            for holding in self._holdings:
                holding.check_silence()

    async def _ask_all(self) -> None:
        if self._nc.is_connected:
            for holding in self._holdings:
                await holding.consumer.renew()

    def _try_for(self, number: int, now_s: float) -> None:
        holding = PartitionLease(
            self._nc,
            number,
            self._bucket.packs,
            self._keeping,
            self._inbox,
            self._turn,
            partitions=self._partitions,
            is_busy=lambda: any(each.consumer.waiting for each in self._holdings),
        )
        holding.due_s = now_s + self._options.checkpoint_s * (number + 1) / self._partitions
        self._held[number] = holding, asyncio.create_task(holding.run())

    def _give_back(self, number: int) -> None:
        if number not in self._returning:
            self._returning[number] = asyncio.create_task(self._return(*self._held[number]))

    async def _return(self, holding: PartitionLease, task: asyncio.Task[None]) -> None:
        await end(task)
        async with self._few:
            if self._nc.is_connected:
                await holding.release()
        self._blocks, self._samples = self._blocks + holding.blocks, self._samples + holding.samples
        self._faults += holding.faults
        del self._held[holding.number], self._returning[holding.number]

    async def _save(self) -> None:
        """Write the checkpoints that are due."""
        for holding in sorted(self._holdings, key=lambda each: each.due_s):
            now_s = time.monotonic()
            if holding.due_s <= now_s and self._nc.is_connected:
                holding.due_s = now_s + self._options.checkpoint_s
                await self._try(holding, holding.save)

    async def _send_hours(self) -> None:
        for holding in self._holdings:
            if holding.hours and self._nc.is_connected:
                await self._try(holding, holding.send_hours)

    async def _try(self, holding: PartitionLease, what: Callable[[], Awaitable[None]]) -> None:
        try:
            await what()
        except TROUBLES as error:
            log.warning("the server does not keep what it is given", partition=holding.number, reason=error_text(error))

    async def _settle(self) -> None:
        """Notify partitions of packs with changed settings or newly known packs."""
        while True:
            for pack in await self._changed.get():
                held = self._held.get(subjects.partition_of(pack, self._partitions))
                if held:
                    held[0].settings_changed(pack)

    def _heartbeat(self) -> Heartbeat:
        holdings = [holding for holding in self._holdings if holding.is_owned]
        counters, unknown = Counter[str](), list[str]()
        for holding in holdings:
            if holding.partition:
                counters.update(holding.partition.counters)
                unknown += holding.partition.unknown
        lags = [holding.lag_s for holding in holdings if holding.lag_s is not None]
        for holding in holdings:
            holding.lag_s = None
        usage = resource.getrusage(resource.RUSAGE_SELF)
        ages = [time.time() - kept.made_s for holding in holdings if (kept := holding.last_checkpoint)]
        return Heartbeat(
            id=self._options.name,
            started_s=self._started_s,
            leaving=self._leaving,
            partitions=tuple(holding.number for holding in holdings),
            packs=counters["packs"],
            blocks=self._blocks + sum(holding.blocks for holding in self._holdings),
            samples=self._samples + sum(holding.samples for holding in self._holdings),
            faults=self._faults + sum(holding.faults for holding in self._holdings),
            lag_s=max(lags, default=None),
            counters=dict(counters),
            unknown_count=len(unknown),
            unknown=tuple(sorted(unknown)[:MAX_UNKNOWN]),
            waiting=sum(len(holding.consumer.waiting) for holding in self._holdings),
            hours_waiting=sum(len(holding.hours) for holding in self._holdings),
            checkpoint_age_s=max(ages, default=None),
            cpu_s=usage.ru_utime + usage.ru_stime,
            rss_mib=_rss_mib(),
            trouble=next((holding.trouble for holding in self._holdings if holding.trouble), self._bucket.fault),
        )


async def _each(period_s: float, what: Callable[[], Awaitable[None]]) -> None:
    """Do it again and again; missed calls are not repeated."""
    while True:
        await what()
        await asyncio.sleep(period_s)


def _rss_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20
