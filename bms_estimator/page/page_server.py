"""Server of the live page of packs: event stream, history, and forecasts under a load that the user gives."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from aiohttp import web

from bms_estimator.model.errors import UserError
from bms_estimator.page.history_query import SPANS, HistoryQuery
from bms_estimator.page.pack_topics import PackTopics
from bms_estimator.page.web_server import File, WebServer
from bms_estimator.settings.connections import PageSettings
from bms_estimator.sinks.mqtt.requests import MAX_READ_BYTES

HISTORY_TIMEOUT_S = 10.0
"""Timeout of a history query [s]. A disk that needs longer counts as hung."""
MAX_HISTORY_QUERIES = 4
"""Maximum number of history queries that wait for the disk. Further queries wait until one of these has ended."""

STATIC = Path(__file__).with_name("static")
SCRIPTS = (
    "cells.js",
    "charts.js",
    "curves.js",
    "dom.js",
    "elements.js",
    "forecast.js",
    "format.js",
    "health.js",
    "live.js",
    "packs.js",
    "page.js",
    "parameters.js",
    "state.js",
    "uplot.js",
    "what_if.js",
)
FILES = {
    "/": File(STATIC / "index.html", "text/html"),
    "/style.css": File(STATIC / "style.css", "text/css"),
    **{f"/{name}": File(STATIC / name, "text/javascript") for name in SCRIPTS},
    "/icon.svg": File(STATIC / "icon.svg", "image/svg+xml"),
}

ForecastHandler = Callable[[bytes], Awaitable[bytes | None]]
"""Function that answers the payload of a request ``forecast``; None: too many requests."""


class PageServer(WebServer):
    """Server of the live page of packs; a context manager.

    Args:
        settings: Address and access of the page.
        pack_topics: Present state of the packs.
        history: History of the packs.
        forecasts: Functions that answer requests for a forecast, by pack. The caller may add and remove packs.
        on_listening: Called with the address of the page once the server listens; ``str`` ignores it.
        retry: True: retry an address that is in use or does not exist yet; False: raise an error.

    Raises:
        UserError: The token cannot be read.
    """

    def __init__(
        self,
        settings: PageSettings,
        pack_topics: PackTopics,
        history: HistoryQuery,
        forecasts: Mapping[str, ForecastHandler] = MappingProxyType({}),
        *,
        on_listening: Callable[[str], object] = str,
        retry: bool = True,
    ) -> None:
        super().__init__(
            settings,
            FILES,
            pack_topics,
            {"/history": self._answer_history},
            forms={"/forecast": self._answer_forecast},
            max_form_bytes=MAX_READ_BYTES,
            on_listening=on_listening,
            retry=retry,
        )
        self._history, self._forecasts = history, forecasts
        self._query_slots = asyncio.Semaphore(MAX_HISTORY_QUERIES)

    async def _answer_history(self, request: web.Request) -> web.StreamResponse:
        pack, span = request.query.get("pack", ""), request.query.get("span", "")
        if span not in SPANS:
            raise web.HTTPBadRequest(text=f"span: must be one of {', '.join(SPANS)}\n")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(HISTORY_TIMEOUT_S), self._query_slots:
                body = await loop.run_in_executor(self._history.thread, self._history.read, pack, span)
        except UserError as error:
            raise web.HTTPNotFound(text=f"{error}\n") from None
        except TimeoutError:
            raise web.HTTPServiceUnavailable(text="the disk does not answer\n") from None
        return web.Response(body=body, content_type="application/json", headers={"Cache-Control": "no-store"})

    async def _answer_forecast(self, request: web.Request) -> web.StreamResponse:
        """Answer a request ``forecast`` in JSON. A form of a foreign page cannot have this content type."""
        if request.content_type != "application/json":
            raise web.HTTPUnsupportedMediaType(text="the content type must be application/json\n")
        forecast = self._forecasts.get(request.query.get("pack", ""))
        if forecast is None:
            raise web.HTTPNotFound(text="forecasts are made where the service of the pack runs\n")
        try:
            payload = await request.read()
        except web.RequestPayloadError:
            raise web.HTTPBadRequest(text="the payload cannot be decoded\n") from None
        body = await forecast(payload)
        if body is None:
            raise web.HTTPTooManyRequests(text="too many requests; wait some seconds\n")
        return web.Response(body=body, content_type="application/json", headers={"Cache-Control": "no-store"})
