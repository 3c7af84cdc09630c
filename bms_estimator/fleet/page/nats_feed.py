"""Feed of the fleet's page: states, parameters, hours, heartbeats, unknown packs, dead letters, and the table of packs."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import nats.errors
import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import check_credentials_file, close, connect, tls_context
from bms_estimator.fleet.nats.dead_packs import DeadPackReader
from bms_estimator.fleet.nats.stream_reader import StreamError, read_stream
from bms_estimator.fleet.nats.streams import partitions_of
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import end_tasks

TABLE_S = 2.0
"""Poll interval for changes of the table of packs and of the dead letters, and retry interval [s]."""
HOURS_S = 3900.0
"""Maximum age of hourly summaries that are read at the start [s]: an hour, and five minutes of delay."""
MAX_BYTES = 1 << 16
"""Maximum size of a processed message [bytes]."""
MAX_REASON = 200
"""Maximum length of the reason why a pack is unknown [bytes]."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Server:
    """Address and credentials of the fleet's server.

    Attributes:
        urls: Address ``nats://host:port`` or ``tls://host:port``, or several separated by commas.
        creds: Credentials file; None: without credentials.
        ca: Certificate of the authority that signed the server's certificate; None: the system's authorities.
    """

    urls: str
    creds: Path | None = None
    ca: Path | None = None


class FleetFeed:
    """Feed that updates a view while the context lasts.

    Args:
        server: Address of the fleet's server.
        view: View to update.
        on_link_change: Called with the reason when there is no connection, and with None when the connection is
            (re-)established.

    Raises:
        UserError: The credentials or the certificate cannot be read.
    """

    def __init__(self, server: Server, view: FleetView, on_link_change: Callable[[str | None], None]) -> None:
        if server.creds is not None:
            check_credentials_file(server.creds)
        if server.ca is not None:
            tls_context(server.ca)
        self._server, self._view, self._on_link_change = server, view, on_link_change
        self._nc: Client | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Start to connect in the background."""
        self._set_link_state("not reached yet")
        self._task = asyncio.create_task(self._run(), name="fleet feed")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Disconnect."""
        if self._task is not None:
            await end_tasks(self._task)
        if self._nc is not None:
            await close(self._nc)

    async def _run(self) -> None:
        """Receive messages until cancelled; report an error to the page."""
        try:
            await self._receive()
        except UserError as error:
            log.error("the feed from the fleet's server has ended", reason=str(error))  # noqa: TRY400 - a user error needs no traceback
            self._set_link_state(str(error))
        except Exception:
            log.exception("the feed from the fleet's server has ended")
            self._set_link_state("internal error of the page, see its log; restart the page")

    async def _receive(self) -> None:
        """Connect, subscribe, poll the table, and read recent hours. The library reconnects and renews subscriptions by itself.

        Raises:
            UserError: The address cannot be used, or the server has closed the connection permanently.
        """
        server, name = self._server, "bms-estimator fleet page"
        self._nc = await connect(
            server.urls, name, creds=server.creds, ca=server.ca, on_link_change=self._set_link_state
        )
        for subject, handler in self._handlers().items():
            await self._nc.subscribe(subject, cb=handler)
        self._set_link_state(None)
        # No TaskGroup: it cancels its tasks only once, and the library may swallow a cancellation.
        await asyncio.gather(self._poll_table(self._nc), self._read_recent_hours(self._nc))

    def _handlers(self) -> dict[str, Callable[[Msg], Coroutine[Any, Any, None]]]:
        """Return the message handlers by subject."""
        view, clock = self._view, time.monotonic

        async def state(message: Msg) -> None:
            if len(message.data) <= MAX_BYTES:
                view.packs.receive_state(_pack_name(message), message.data, clock())

        async def parameters(message: Msg) -> None:
            if len(message.data) <= MAX_BYTES:
                view.packs.receive_parameters(_pack_name(message), message.data)

        async def hour(message: Msg) -> None:
            view.packs.receive_hour_summary(_pack_name(message), message.data)

        async def worker(message: Msg) -> None:
            view.receive_worker(message.data, clock())

        async def unknown(message: Msg) -> None:
            view.receive_unknown(message.subject.rpartition(".")[2], message.data[:MAX_REASON].decode(errors="replace"))

        return {
            subjects.published("*", "state"): state,
            subjects.published("*", "parameters"): parameters,
            subjects.hours(): hour,
            subjects.worker(): worker,
            subjects.unknown(): unknown,
        }

    async def _poll_table(self, nc: Client) -> None:
        """Poll the table of packs and the dead letters until cancelled."""
        bucket, dead_packs, view = PackBucket(nc), DeadPackReader(nc), self._view

        async def refresh() -> None:
            view.workers.partitions = await partitions_of(nc) or view.workers.partitions
            for pack in await bucket.refresh():
                spec = bucket.packs.parsed_row(pack)
                view.set_pack_type(pack, None if spec is None else type_name(spec))
            view.dead_packs = await dead_packs.read()

        while True:
            await self._retry(refresh)
            await asyncio.sleep(TABLE_S)

    async def _read_recent_hours(self, nc: Client) -> None:
        """Read the summaries of the last hour before the start of this page."""
        since_s = time.time() - HOURS_S

        async def read() -> None:
            async for batch in read_stream(nc, subjects.HOURS_STREAM, subjects.hours(), since_s=since_s):
                for message in batch:
                    self._view.packs.receive_hour_summary(message.subject.split(".")[1], message.data)

        await self._retry(read)

    async def _retry(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Repeat ``work`` until the server answers and has the stream."""
        while True:
            try:
                return await work()
            except (StreamError, UserError, nats.errors.Error) as error:
                if self._nc is not None and self._nc.is_closed:
                    raise UserError("the server has closed the connection: check --creds") from None
                log.warning("a request to the fleet's server failed; trying again", reason=str(error))
            await asyncio.sleep(TABLE_S)

    def _set_link_state(self, trouble: str | None) -> None:
        if trouble is None:
            self._view.set_connected(time.monotonic())
        else:
            self._view.set_disconnected()
        self._on_link_change(trouble and f"{self._server.urls}: {trouble}")


def type_name(spec: PackSpec | str) -> str:
    """Return the type of a table row, such as ``lfp 16s2p 280 Ah``, or that the row is wrong."""
    if isinstance(spec, str):
        return "wrong rows"
    capacity = "" if spec.capacity_ah is None else f" {spec.capacity_ah:g} Ah"
    return f"{spec.cell} {spec.series}s{spec.parallel}p{capacity}"


def _pack_name(message: Msg) -> str:
    return message.subject.split(".", 2)[1]
