"""Sink that shows a service's packs on the page, as the payloads of MQTT. Packs with one address share a server."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Self

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.message import Message
from bms_estimator.mqtt.topic_cache import parse_payload
from bms_estimator.page.history_query import HistoryQuery
from bms_estimator.page.pack_topics import PackTopics
from bms_estimator.page.page_server import Forecast, PageServer
from bms_estimator.settings.page import PageSettings
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState


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
        forecast: Forecast | None = None,
    ) -> None:
        self._pages, self._settings, self._pack, self._history = pages, settings, pack, history
        self._forecast = forecast
        self._messages = MessageBuilder("", pack)
        self._previous: Snapshot | None = None
        self._sent = PublishedState()
        self._hub = PackTopics()
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Start to serve the page."""
        self._hub = await self._stack.enter_async_context(
            self._pages.serving(self._settings, self._pack, self._history, self._forecast)
        )
        self._put(self._messages.birth_messages())
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the streams of all browsers."""
        self._put(self._messages.offline_messages())
        await self._stack.aclose()

    def publish(self, snapshot: Snapshot) -> None:
        """Store a snapshot for the page, without blocking."""
        now_s = asyncio.get_running_loop().time()
        messages, self._sent = self._messages.live_messages(self._sent, snapshot, now_s)
        self._put(self._messages.guaranteed_messages(self._previous, snapshot) + messages)
        self._previous = snapshot

    def _put(self, messages: list[Message]) -> None:
        root = f"{self._messages.root}/"
        for message in messages:
            if message.topic.startswith(root):
                self._hub.put(self._pack, message.topic.removeprefix(root), parse_payload(message.payload))


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
        self, settings: PageSettings, pack: str, history: Path | None, forecast: Forecast | None
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
            yield page.hub
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
        self.hub, self.history_query, self.forecasts = PackTopics(), HistoryQuery(), dict[str, Forecast]()
        self._server = PageServer(settings, self.hub, self.history_query, self.forecasts, on_listening=on_listening)
        self._start_task: asyncio.Task[PageServer] | None = None

    async def start(self) -> None:
        """Start the server, unless an earlier pack started it."""
        if self._start_task is None:
            self._start_task = asyncio.ensure_future(self._server.__aenter__())
        await asyncio.shield(self._start_task)

    async def stop(self) -> None:
        """End the server, if it was started."""
        if self._start_task is not None:
            await asyncio.wait([self._start_task])
            await self._server.__aexit__(None, None, None)
