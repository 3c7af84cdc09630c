"""Server of the live page of packs: event stream and history."""

import asyncio
from collections.abc import Callable
from pathlib import Path

from aiohttp import web

from bms_estimator.model.errors import UserError
from bms_estimator.page.history_query import SPANS, HistoryQuery
from bms_estimator.page.pack_topics import PackTopics
from bms_estimator.page.web_server import File, WebServer
from bms_estimator.settings.page import PageSettings

HISTORY_TIMEOUT_S = 10.0
"""Timeout of a history query [s]. A disk that needs longer counts as hung."""
MAX_HISTORY_QUERIES = 4
"""Maximum number of history queries that wait for the disk; further ones wait for these."""

STATIC = Path(__file__).with_name("static")
FILES = {
    "/": File(STATIC / "index.html", "text/html"),
    "/style.css": File(STATIC / "style.css", "text/css"),
    "/page.js": File(STATIC / "page.js", "text/javascript"),
    "/live.js": File(STATIC / "live.js", "text/javascript"),
    "/format.js": File(STATIC / "format.js", "text/javascript"),
    "/charts.js": File(STATIC / "charts.js", "text/javascript"),
    "/uplot.js": File(STATIC / "uplot.js", "text/javascript"),
    "/icon.svg": File(STATIC / "icon.svg", "image/svg+xml"),
}
"""Static files by URL path."""


class PageServer(WebServer):
    """Server of the live page of packs; a context manager.

    Args:
        settings: Address and access of the page.
        hub: Present state of the packs.
        past: History of the packs.
        opened: Called with its address once it is served.
        patient: True: retry an address that is in use or does not exist yet; False: raise an error.

    Raises:
        UserError: The token cannot be read.
    """

    def __init__(
        self,
        settings: PageSettings,
        hub: PackTopics,
        past: HistoryQuery,
        *,
        opened: Callable[[str], object] = str,
        patient: bool = True,
    ) -> None:
        super().__init__(settings, FILES, hub, {"/history": self._history}, opened=opened, patient=patient)
        self._past = past
        self._histories = asyncio.Semaphore(MAX_HISTORY_QUERIES)

    async def _history(self, request: web.Request) -> web.StreamResponse:
        pack, span = request.query.get("pack", ""), request.query.get("span", "")
        if span not in SPANS:
            raise web.HTTPBadRequest(text=f"span: must be one of {', '.join(SPANS)}\n")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(HISTORY_TIMEOUT_S), self._histories:
                body = await loop.run_in_executor(self._past.thread, self._past.read, pack, span)
        except UserError as error:
            raise web.HTTPNotFound(text=f"{error}\n") from None
        except TimeoutError:
            raise web.HTTPServiceUnavailable(text="the disk does not answer\n") from None
        return web.Response(body=body, content_type="application/json", headers={"Cache-Control": "no-store"})
