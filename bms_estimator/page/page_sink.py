"""Sink that shows a service's packs on the page, from the payloads of MQTT. Packs with one address share a server."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Self

from bms_estimator.model.errors import UserError
from bms_estimator.model.events import events
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.page.history_query import HistoryQuery
from bms_estimator.page.pack_topics import EVENT, STATE, PackTopics
from bms_estimator.page.page_server import ForecastHandler, PageServer
from bms_estimator.settings.connections import PageSettings
from bms_estimator.sinks.mqtt.messages import AVAILABILITY, SENSOR_AVAILABILITY, changed_payloads


class PageSink:
    """Sink that shows one pack's snapshots.

    Args:
        pages: The servers of this process.
        settings: Settings of the page.
        pack: Name of the pack.
        history: File of its history; None: no history.
        forecast: Function that answers requests for a forecast; None: there are none.
    """

    def __init__(
        self,
        pages: "Pages",
        settings: PageSettings,
        pack: str,
        history: Path | None = None,
        forecast: ForecastHandler | None = None,
    ) -> None:
        self._pages, self._settings, self._pack, self._history = pages, settings, pack, history
        self._forecast = forecast
        self._previous: Snapshot | None = None
        self._pack_topics = PackTopics()
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Start to serve the page."""
        self._pack_topics = await self._stack.enter_async_context(
            self._pages.serving(self._settings, self._pack, self._history, self._forecast)
        )
        self._pack_topics.put(self._pack, AVAILABILITY, "online")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Set the pack offline. The last pack of an address ends its server."""
        for topic in (SENSOR_AVAILABILITY, AVAILABILITY):
            self._pack_topics.put(self._pack, topic, "offline")
        await self._stack.aclose()

    def publish(self, snapshot: Snapshot) -> None:
        """Store a snapshot for the page, without blocking."""
        for event in events(self._previous, snapshot):
            self._pack_topics.put(self._pack, EVENT, event)
        if snapshot.estimate:
            self._pack_topics.put(self._pack, STATE, snapshot.estimate)
        for topic, payload in changed_payloads(self._previous, snapshot):
            self._pack_topics.put(self._pack, topic, payload)
        self._pack_topics.put(self._pack, SENSOR_AVAILABILITY, "online" if snapshot.health.sensor_online else "offline")
        self._previous = snapshot


class Pages:
    """Page servers of a process, one for each configured address.

    Args:
        on_listening: Called with the address of each server once it listens.
    """

    def __init__(self, on_listening: Callable[[str], object] = str) -> None:
        self._on_listening = on_listening
        self._by_address: dict[str, _Page] = {}

    @contextlib.asynccontextmanager
    async def serving(
        self, settings: PageSettings, pack: str, history: Path | None, forecast: ForecastHandler | None
    ) -> AsyncIterator[PackTopics]:
        """Show a pack. The first pack starts the server of its address, the last one ends it.

        Raises:
            UserError: Two packs have one address with different tokens, or the token cannot be read.
        """
        page = self._by_address.get(settings.listen)
        if page is None:
            page = self._by_address[settings.listen] = _Page(settings, self._on_listening)
        page.packs += 1
        try:
            if page.settings != settings:
                raise UserError(f"page: packs that share listen = {settings.listen} must share token_file and hosts")
            if history:
                page.history_query.add(pack, history)
            if forecast:
                page.forecasts[pack] = forecast
            await page.start()
            yield page.pack_topics
        finally:
            page.packs -= 1
            page.forecasts.pop(pack, None)
            if not page.packs:
                del self._by_address[settings.listen]
                await page.stop()


class _Page:
    """Page server and the number of its packs."""

    def __init__(self, settings: PageSettings, on_listening: Callable[[str], object]) -> None:
        self.settings, self.packs = settings, 0
        self.pack_topics, self.history_query, self.forecasts = (
            PackTopics(),
            HistoryQuery(),
            dict[str, ForecastHandler](),
        )
        self._server = PageServer(
            settings, self.pack_topics, self.history_query, self.forecasts, on_listening=on_listening
        )
        self._start_task: asyncio.Task[PageServer] | None = None

    async def start(self) -> None:
        """Start the server, unless an earlier pack started it. The cancellation of one pack does not cancel the start."""
        if self._start_task is None:
            self._start_task = asyncio.ensure_future(self._server.__aenter__())
        await asyncio.shield(self._start_task)

    async def stop(self) -> None:
        """End the server, if it was started."""
        if self._start_task is not None:
            await asyncio.wait([self._start_task])
            await self._server.__aexit__(None, None, None)
