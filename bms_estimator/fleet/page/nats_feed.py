"""Messages of a fleet for its page: states, parameters, hours, workers, unknown packs, and the table of packs."""

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
from bms_estimator.fleet.nats.connection import connect, context, part, readable
from bms_estimator.fleet.nats.stream_reader import StreamError, read_stream
from bms_estimator.fleet.nats.streams import partitions_of
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.model.errors import UserError
from bms_estimator.process.tasks import end

TABLE_S = 2.0
"""Poll interval for changes of the table of packs, and retry interval [s]."""
HOURS_S = 3900.0
"""Interval of hourly summaries, with a delay [s]."""
MAX_BYTES = 1 << 16
"""Maximum length of a message."""
MAX_REASON = 200
"""Bytes of why a pack is unknown."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Server:
    """Address and credentials of the fleet's server.

    Attributes:
        urls: nats://host:port, or tls://; several with commas between.
        creds: File with what opens its door; None: none is needed.
        ca: Certificate of the authority that has signed its own; None: those of the system.
    """

    urls: str
    creds: Path | None = None
    ca: Path | None = None


class FleetFeed:
    """Fills a view while the context lasts.

    Args:
        server: Address of the fleet's server.
        view: Filled.
        linked: Called with why there is no server, and with None when there is.

    Raises:
        UserError: The credentials or the certificate cannot be read.
    """

    def __init__(self, server: Server, view: FleetView, linked: Callable[[str | None], None]) -> None:
        if server.creds is not None:
            readable(server.creds)
        if server.ca is not None:
            context(server.ca)
        self._server, self._view, self._linked = server, view, linked
        self._nc: Client | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Start reaching for the server."""
        self._on_link("not reached yet")
        self._task = asyncio.create_task(self._run(), name="fleet feed")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Part from the server."""
        if self._task is not None:
            await end(self._task)
        if self._nc is not None:
            await part(self._nc)

    async def _run(self) -> None:
        """Listen for ever; the page shows why it ended."""
        try:
            await self._listen()
        except UserError as error:
            log.error("nothing more is heard from the fleet's server", reason=str(error))  # noqa: TRY400 - of a person
            self._on_link(str(error))
        except Exception:
            log.exception("nothing more is heard from the fleet's server")
            self._on_link("a fault of the page, which its log tells: start it again")

    async def _listen(self) -> None:
        """Connect, which lasts until there is a server; then the library stays connected, and subscribed.

        Raises:
            UserError: The address cannot be used, or the server has closed the connection permanently.
        """
        server, name = self._server, "bms-estimator fleet page"
        self._nc = await connect(server.urls, name, creds=server.creds, ca=server.ca, linked=self._on_link)
        for subject, heard in self._handlers().items():
            await self._nc.subscribe(subject, cb=heard)
        self._on_link(None)
        # no group of tasks: it cancels its own once only, and the library may swallow that
        await asyncio.gather(self._follow_table(self._nc), self._read_hours(self._nc))

    def _handlers(self) -> dict[str, Callable[[Msg], Coroutine[Any, Any, None]]]:
        view, clock = self._view, time.monotonic

        async def state(message: Msg) -> None:
            if len(message.data) <= MAX_BYTES:
                view.packs.receive_state(_pack(message), message.data, clock())

        async def parameters(message: Msg) -> None:
            if len(message.data) <= MAX_BYTES:
                view.packs.receive_parameters(_pack(message), message.data)

        async def hour(message: Msg) -> None:
            view.packs.receive_hour(_pack(message), message.data)

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

    async def _follow_table(self, nc: Client) -> None:
        """Register the packs in the table."""
        bucket, view = PackBucket(nc), self._view

        async def refresh() -> None:
            view.workers.partitions = await partitions_of(nc) or view.workers.partitions
            for pack in await bucket.refresh():
                kind = bucket.packs.kind(pack)
                view.know(pack, None if kind is None else type_name(kind))

        while True:
            await self._patiently(refresh)
            await asyncio.sleep(TABLE_S)

    async def _read_hours(self, nc: Client) -> None:
        """Read the summaries of the last hour from before this page started."""
        since_s = time.time() - HOURS_S

        async def read() -> None:
            async for batch in read_stream(nc, subjects.HOURS_STREAM, subjects.hours(), since_s=since_s):
                for message in batch:
                    self._view.packs.receive_hour(message.subject.split(".")[1], message.data)

        await self._patiently(read)

    async def _patiently(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Do what a server is needed for; where it does not answer, or has no such stream, again later."""
        while True:
            try:
                return await work()
            except (StreamError, UserError, nats.errors.Error) as error:
                if self._nc is not None and self._nc.is_closed:
                    raise UserError("the server has closed the connection: look at --creds") from None
                log.warning("the fleet's server does not tell", reason=str(error))
            await asyncio.sleep(TABLE_S)

    def _on_link(self, trouble: str | None) -> None:
        if trouble is None:
            self._view.begin(time.monotonic())
        else:
            self._view.end()
        self._linked(trouble and f"{self._server.urls}: {trouble}")


def type_name(kind: PackSpec | str) -> str:
    """Return the type of a table row, such as ``lfp 16s2p 280 Ah``, or that the row is wrong."""
    if isinstance(kind, str):
        return "wrong rows"
    capacity = "" if kind.capacity_ah is None else f" {kind.capacity_ah:g} Ah"
    return f"{kind.cell} {kind.series}s{kind.parallel}p{capacity}"


def _pack(message: Msg) -> str:
    return message.subject.split(".", 2)[1]
