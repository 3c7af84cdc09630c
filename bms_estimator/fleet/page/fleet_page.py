"""The page of a fleet: latest messages, sent to browsers at a limited rate, and details of one pack on request."""

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from aiohttp import web

from bms_estimator.edge.subjects import PARTITIONS
from bms_estimator.fleet.page.nats_feed import FleetFeed, Server
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.page.event_stream import LatestValues
from bms_estimator.page.page_server import STATIC as SHARED
from bms_estimator.page.web_server import File, WebServer
from bms_estimator.settings.page import PageSettings

STEP_S = 2.0
"""Interval between two pictures of the fleet [s]."""
ASK_S = 600.0
"""Interval between two queries of the hours [s]."""
FLEET, ANSWERS = "fleet", "answers"
"""Keys of the event stream."""
STATIC = Path(__file__).with_name("static")
FILES = {
    "/": File(STATIC / "fleet.html", "text/html"),
    "/fleet.css": File(STATIC / "fleet.css", "text/css"),
    "/fleet.js": File(STATIC / "fleet.js", "text/javascript"),
    "/style.css": File(SHARED / "style.css", "text/css"),
    "/live.js": File(SHARED / "live.js", "text/javascript"),
    "/format.js": File(SHARED / "format.js", "text/javascript"),
    "/icon.svg": File(SHARED / "icon.svg", "image/svg+xml"),
}
"""All that is served, by its path."""


@contextlib.asynccontextmanager
async def fleet_page(
    server: Server, settings: PageSettings, hours: Path | None = None, *, step_s: float = STEP_S
) -> AsyncIterator[str]:
    """Serve while the context lasts.

    Args:
        server: Address of the fleet's server.
        settings: Address and access of the page.
        hours: Folder of the Parquet files for queries; None: none are.
        step_s: Interval of the summaries [s].

    Yields:
        The page's address.

    Raises:
        UserError: A setting cannot be used, or the address is taken.
    """
    newest, view = LatestValues(), FleetView(PARTITIONS, time.monotonic())

    async def packs(request: web.Request) -> web.Response:
        return _json(view.packs.find(request.query.get("prefix", "")))

    async def pack(request: web.Request) -> web.Response:
        name = request.query.get("name", "")
        found = view.packs.one(name, time.monotonic())
        if found is None:
            raise web.HTTPNotFound(text="no such pack was heard of\n")
        return _json(found)

    async with (
        WebServer(settings, FILES, newest, {"/packs": packs, "/pack": pack}, patient=False) as page,
        FleetFeed(server, view, newest.set_link_state),
    ):
        tasks = [asyncio.create_task(_draw(view, newest, step_s), name="fleet page")]
        if hours is not None:
            tasks.append(asyncio.create_task(_ask(hours, newest), name="fleet questions"))
        try:
            yield page.url
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _draw(view: FleetView, newest: LatestValues, step_s: float) -> None:
    """Send a picture at intervals; while the server is lost the last one stays."""
    while True:
        if view.listening:
            newest.set_value(FLEET, view.text(time.monotonic(), time.time()))
        await asyncio.sleep(step_s)


async def _ask(hours: Path, newest: LatestValues) -> None:
    """Query the hours at intervals, which takes seconds for a large fleet. The process ends after the current query."""
    from bms_estimator.fleet.page.query_results import ASKED, answer  # noqa: PLC0415 - duckdb is needed for nothing else

    while True:
        found = {name: await asyncio.to_thread(answer, hours, name) for name in ASKED}
        newest.set_value(ANSWERS, json.dumps(found, allow_nan=False, separators=(",", ":")))
        await asyncio.sleep(ASK_S)


def _json(value: Any) -> web.Response:
    body = json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
    return web.Response(body=body, content_type="application/json", headers={"Cache-Control": "no-store"})
