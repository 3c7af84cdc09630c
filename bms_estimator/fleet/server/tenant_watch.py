"""Watch over one tenant: heartbeats of its workers, its streams, unsaved blocks, and silent packs and alarms."""

import asyncio
import contextlib
import time
from pathlib import Path

import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.fleet_workers import FleetWorkers
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.metrics.states import Problems, StreamState, TenantState
from bms_estimator.fleet.nats.backlog import undelivered_messages
from bms_estimator.fleet.nats.connection import close
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.fleet.nats.streams import RESPONSE_TIMEOUT_S
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_blocks
from bms_estimator.fleet.server.arrival_watch import ArrivalWatch
from bms_estimator.fleet.server.local_client import connect
from bms_estimator.fleet.server.nats_config import Node

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
        with contextlib.suppress(ValidationError):  # of another version; `fleet status` reports it
            self._workers.receive(Heartbeat.model_validate_json(message.data), time.monotonic())
