"""What a fleet publishes, heard for its page: states, parameters, hours, workers, unknown packs, and the table of packs."""

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import nats.errors
import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.fleet import subjects
from bms_estimator.fleet.pack_bucket import PackBucket
from bms_estimator.fleet.pack_row import PackKind
from bms_estimator.fleet.page_view import FleetView
from bms_estimator.fleet.stream_reader import StreamError, read_stream
from bms_estimator.fleet.streams import partitions_of
from bms_estimator.model.errors import UserError

AGAIN_S = 2.0
"""Before a server that is lost, or a table that cannot be read, is tried again [s]."""
TABLE_S = 5.0
"""Between two looks for what has changed in the table of packs [s]."""
HOURS_S = 3900.0
"""Summaries of an hour come once in that, and somewhat late [s]."""
MOST_BYTES = 1 << 16
"""Nothing of ours is longer."""
CLOSING_S = 3.0

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Server:
    """Where the fleet's server is.

    Attributes:
        url: nats://host:port, or tls://; several with commas between.
        creds: File with what opens its door; None: none is needed.
    """

    url: str
    creds: Path | None = None


class FleetFeed:
    """Fills a view while the context lasts.

    Args:
        server: Where to listen.
        view: Filled.
        linked: Called with why there is no server, and with None when there is.

    Raises:
        UserError: The credentials cannot be read.
    """

    def __init__(self, server: Server, view: FleetView, linked: Callable[[str | None], None]) -> None:
        if server.creds is not None and not server.creds.is_file():
            raise UserError(f"--creds {server.creds}: no such file")
        self._server, self._view, self._linked = server, view, linked
        self._nc = Client()
        self._why = "not reached yet"
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        """Start reaching for the server."""
        self._say_lost()
        self._tasks.append(asyncio.create_task(self._run(), name="fleet feed"))
        return self

    async def __aexit__(self, *_: object) -> None:
        """Part from the server."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        with contextlib.suppress(nats.errors.Error, OSError, TimeoutError):
            async with asyncio.timeout(CLOSING_S):
                await self._nc.close()

    async def _run(self) -> None:
        """Connect, which lasts until there is a server; then the library stays connected, and subscribed."""
        await self._nc.connect(
            self._server.url.split(","),
            name="bms-estimator fleet page",
            max_reconnect_attempts=-1,
            reconnect_time_wait=AGAIN_S,  # type: ignore[arg-type]  # it sleeps so long
            user_credentials=str(self._server.creds) if self._server.creds else None,
            error_cb=self._on_error,
            disconnected_cb=self._on_lost,
            reconnected_cb=self._on_back,
        )
        for subject, heard in self._heard().items():
            await self._nc.subscribe(subject, cb=heard)
        await self._on_back()
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow_table())
            tasks.create_task(self._patiently(self._read_hours))

    def _heard(self) -> dict[str, Callable[[Msg], Coroutine[Any, Any, None]]]:
        view, clock = self._view, time.monotonic

        async def state(message: Msg) -> None:
            if len(message.data) <= MOST_BYTES:
                view.packs.hear_state(_pack(message), message.data, clock())

        async def parameters(message: Msg) -> None:
            if len(message.data) <= MOST_BYTES:
                view.packs.hear_parameters(_pack(message), message.data)

        async def hour(message: Msg) -> None:
            view.packs.hear_hour(_pack(message), message.data)

        async def worker(message: Msg) -> None:
            view.hear_worker(message.data, clock())

        async def unknown(message: Msg) -> None:
            view.hear_unknown(message.subject.rpartition(".")[2], clock())

        return {
            subjects.published("*", "state"): state,
            subjects.published("*", "parameters"): parameters,
            subjects.hours(): hour,
            subjects.worker(): worker,
            subjects.unknown(): unknown,
        }

    async def _follow_table(self) -> None:
        """Know the packs that are in the table."""
        bucket = PackBucket(self._nc)

        async def refresh() -> None:
            self._view.workers.partitions = await partitions_of(self._nc) or self._view.workers.partitions
            for pack in await bucket.refresh():
                kind = bucket.packs.kind(pack)
                self._view.know(pack, None if kind is None else type_name(kind))

        while True:
            await self._patiently(refresh)
            await asyncio.sleep(TABLE_S)

    async def _read_hours(self) -> None:
        """What the last hour's summaries said, before this page was there."""
        since_s = time.time() - HOURS_S
        async for batch in read_stream(self._nc, subjects.HOURS_STREAM, subjects.hours(), since_s=since_s):
            for message in batch:
                self._view.packs.hear_hour(message.subject.split(".")[1], message.data)

    async def _patiently(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Do what a server is needed for; where it does not answer, or has no such stream, again later."""
        while True:
            try:
                return await work()
            except (StreamError, UserError, nats.errors.Error) as error:
                log.warning("the fleet's server does not tell", reason=str(error))
            await asyncio.sleep(TABLE_S)

    def _say_lost(self) -> None:
        self._linked(f"{self._server.url}: {self._why}")

    async def _on_lost(self) -> None:
        self._view.end()
        self._why = "the server is lost"
        self._say_lost()

    async def _on_back(self) -> None:
        self._view.begin(time.monotonic())
        self._linked(None)

    async def _on_error(self, error: Exception) -> None:
        if self._nc.is_connected:
            log.warning("the fleet's server", reason=str(error) or type(error).__name__)
            return
        self._why = str(error) or type(error).__name__
        self._say_lost()


def type_name(kind: PackKind | str) -> str:
    """Of a row of the table, such as ``lfp 16s2p 280 Ah``; of one that is wrong, that it is."""
    if isinstance(kind, str):
        return "wrong rows"
    capacity = "" if kind.capacity_ah is None else f" {kind.capacity_ah:g} Ah"
    return f"{kind.cell} {kind.series}s{kind.parallel}p{capacity}"


def _pack(message: Msg) -> str:
    return message.subject.split(".", 2)[1]
