"""Watch over one tenant: its workers, its streams, undelivered messages, unsaved blocks, silent packs and alarms."""

import asyncio
import contextlib
import re
import time
from pathlib import Path

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from nats.js.api import ConsumerInfo
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.fleet_workers import FleetWorkers
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.metrics.states import Problems, StreamState, TenantState
from bms_estimator.fleet.nats.bucket_reader import BucketReader
from bms_estimator.fleet.nats.connection import close
from bms_estimator.fleet.nats.stream_reader import StreamError, read_stream
from bms_estimator.fleet.nats.streams import RESPONSE_TIMEOUT_S, consumer
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_blocks
from bms_estimator.fleet.server.local_client import connect
from bms_estimator.fleet.server.nats_config import Node

SILENT_S = 3.0 * 3600.0
"""Time without an hourly summary after which a pack counts as silent [s]. A summary arrives when the next hour begins."""
FAULTY_CELL_ALARM = re.compile(rb'"alarms":"[^"]*(weak_cell|cell_short)')
"""Pattern in a summary with an alarm of a faulty cell. Healthy packs can raise all other alarms."""


class ArrivalWatch:
    """Watch over the arrival of summaries; times are of one monotonic clock [s].

    The silence of a pack without a summary counts from the start of the watch, or from its addition to the table.

    Args:
        nc: Connection to the tenant's NATS account.
    """

    def __init__(self, nc: Client) -> None:
        self._nc, self._table = nc, BucketReader(nc, subjects.PACKS_BUCKET)
        self._last_s: dict[str, float] = {}  # by pack of the table
        self._with_alarms = set[str]()
        self._next_sequence: int | None = None  # in the stream ``HOURS``

    async def problems(self, now_s: float) -> Problems:
        """Read the changes since the last call, and return the present numbers.

        Raises:
            StreamError: The server does not respond or rejects a request.
            nats.errors.Error: An error of the connection.
        """

        def set_row(pack: str, row: bytes | None) -> None:
            if row is None:
                self._last_s.pop(pack, None)
                self._with_alarms.discard(pack)
            else:
                self._last_s.setdefault(pack, now_s)

        await self._table.read(set_row)
        if self._next_sequence is None:
            state = (await self._nc.jetstream().stream_info(subjects.HOURS_STREAM)).state
            self._next_sequence = state.last_seq + 1
        rows = read_stream(self._nc, subjects.HOURS_STREAM, subjects.hours(), first=self._next_sequence)
        async for batch in rows:
            for message in batch:
                pack = message.subject.rpartition(".")[2]
                if pack in self._last_s:
                    self._last_s[pack] = now_s
                    (self._with_alarms.add if FAULTY_CELL_ALARM.search(message.data) else self._with_alarms.discard)(
                        pack
                    )
            self._next_sequence = batch[-1].sequence + 1
        return Problems(sum(now_s - last_s > SILENT_S for last_s in self._last_s.values()), len(self._with_alarms))


async def undelivered_messages(nc: Client, partitions: int) -> dict[int, int]:
    """Return the number of undelivered messages of each partition.

    Raises:
        nats.errors.Error: The server does not respond, or has no stream ``RAW``.
    """
    js = nc.jetstream(timeout=RESPONSE_TIMEOUT_S)
    consumers = dict[str, ConsumerInfo]()
    while page := await js.consumers_info(subjects.RAW_STREAM, offset=len(consumers)):
        consumers |= {info.name: info for info in page}
    by_partition = {number: consumers.get(consumer(number)) for number in range(partitions)}
    return {number: info.num_pending or 0 for number, info in by_partition.items() if info}


CHECK_S = 60.0
"""Interval between two checks for unsaved blocks and silent packs [s]."""
LAG_WINDOW_S = 60.0
"""Time over which the largest lag is found [s], at least the usual interval of scrapes."""
RETRY_S = 1.0
"""Delay before the next connection [s]."""

log = structlog.get_logger(__name__)


class TenantWatch:
    """Watch over one tenant.

    Args:
        name: Name of the tenant; empty without tenants.
        node: Node of the server on this machine.
        credentials_file: Credentials of the tenant; None: without credentials.
    """

    def __init__(self, name: str, node: Node, credentials_file: Path | None) -> None:
        self._name, self._node, self._credentials_file = name, node, credentials_file
        self._workers = FleetWorkers(node.partitions, LAG_WINDOW_S)
        self._nc: Client | None = None
        self._unsaved_share: float | None = None
        self._problems: Problems | None = None

    async def run(self) -> None:
        """Receive heartbeats, and log a warning while more than half of the stream is unsaved, until cancelled."""
        last_reason = ""
        while True:
            try:
                await self._watch_until_disconnected()
                last_reason = ""
            except (NatsError, OSError, StreamError) as error:
                if str(error) != last_reason:
                    log.warning("the tenant cannot be watched", tenant=self._name, reason=str(error))
                last_reason = str(error)
            except Exception:  # the server must continue without the watch
                log.exception("the tenant cannot be watched", tenant=self._name)
            await asyncio.sleep(RETRY_S)

    async def state(self) -> TenantState:
        """Return the present state."""
        heartbeats = tuple(self._workers.heartbeats(time.monotonic()))
        if self._nc is None or not self._nc.is_connected:
            return TenantState(heartbeats)
        try:
            undelivered, infos = await asyncio.gather(
                undelivered_messages(self._nc, self._node.partitions),
                self._nc.jetstream(timeout=RESPONSE_TIMEOUT_S).streams_info(),
            )
        except (NatsError, OSError) as error:
            log.warning("the streams cannot be listed", tenant=self._name, reason=str(error))
            return TenantState(heartbeats, unsaved_share=self._unsaved_share)
        streams = {
            info.config.name or "": StreamState(
                info.state.messages,
                info.state.bytes,
                max_bytes if (max_bytes := info.config.max_bytes or 0) > 0 else None,
            )
            for info in infos
        }
        return TenantState(heartbeats, undelivered, streams, self._unsaved_share, self._problems)

    async def _watch_until_disconnected(self) -> None:
        """Connect, and watch until the connection has ended."""
        closed = asyncio.Event()

        async def on_close() -> None:
            closed.set()

        self._nc = nc = await connect(self._node, self._credentials_file, on_close)
        try:
            await nc.subscribe(subjects.worker(), cb=self._receive)
            await self._check_periodically(nc, closed)
        finally:
            self._nc = self._unsaved_share = self._problems = None
            self._workers.clear()
            await close(nc)

    async def _check_periodically(self, nc: Client, closed: asyncio.Event) -> None:
        """Compute the unsaved share and the silent packs periodically until the connection has ended."""
        arrivals = ArrivalWatch(nc)
        while not closed.is_set():
            self._problems = await arrivals.problems(time.monotonic())
            unsaved = await unsaved_blocks(nc, range(self._node.partitions))
            self._unsaved_share = unsaved.share
            if unsaved.warning:
                log.warning(
                    "the stream fills with blocks that no checkpoint includes",
                    tenant=self._name,
                    reason=unsaved.warning,
                )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CHECK_S):
                    await closed.wait()

    async def _receive(self, message: Msg) -> None:
        with contextlib.suppress(ValidationError):  # heartbeat of another version; `fleet status` reports it
            self._workers.receive(Heartbeat.model_validate_json(message.data), time.monotonic())
