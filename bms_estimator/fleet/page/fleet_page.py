"""Web page of a fleet: an overview, sent to browsers at a limited rate, query results, and details of one pack on request."""

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import duckdb
from aiohttp import web

from bms_estimator.edge.subjects import PARTITIONS
from bms_estimator.fleet.page.nats_feed import FleetFeed, Server
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.model.errors import UserError
from bms_estimator.page.event_stream import LatestValues
from bms_estimator.page.page_server import STATIC as SHARED
from bms_estimator.page.web_server import File, WebServer
from bms_estimator.process.runtime import end_tasks
from bms_estimator.settings.connections import PageSettings

PAGE_QUERIES = ("failing", "soh", "outliers", "honest")
"""Names of the queries on the page."""
MAX_ROWS = 20
"""Maximum number of rows of a query's result on the page."""
OVERVIEW_S = 2.0
"""Interval between two overviews of the fleet [s]."""
QUERY_S = 600.0
"""Interval between two runs of the queries [s]."""
FLEET_KEY = "fleet"
"""Key of the overview in the event stream."""
ANSWERS_KEY = "answers"
"""Key of the query results in the event stream."""
STATIC = Path(__file__).with_name("static")
"""Folder of the page's own files."""
FILES = {
    "/": File(STATIC / "fleet.html", "text/html"),
    "/fleet.css": File(STATIC / "fleet.css", "text/css"),
    "/fleet.js": File(STATIC / "fleet.js", "text/javascript"),
    "/style.css": File(SHARED / "style.css", "text/css"),
    "/dom.js": File(SHARED / "dom.js", "text/javascript"),
    "/live.js": File(SHARED / "live.js", "text/javascript"),
    "/format.js": File(SHARED / "format.js", "text/javascript"),
    "/icon.svg": File(SHARED / "icon.svg", "image/svg+xml"),
}
"""Served files by path."""


def run_page_query(folder: Path, name: str) -> dict[str, Any]:
    """Return the result of one of the queries in ``PAGE_QUERIES``.

    Args:
        folder: Folder of the hours, as ``fleet collect`` writes it.
        name: Name of the query.

    Returns:
        ``columns``, the first ``rows``, their number (``count``), and ``notes``; or the reason why they are missing (``reason``).
    """
    try:
        result = run_query(folder, name)
    except (UserError, duckdb.Error, OSError) as error:
        return {"reason": str(error)}
    # the page shows only the rows of ``soh`` that are for a type; these have no pack
    rows = [row for row in result.rows if name != "soh" or row[result.columns.index("pack")] is None]
    return {"columns": result.columns, "rows": rows[:MAX_ROWS], "count": len(rows), "notes": result.notes}


@contextlib.asynccontextmanager
async def fleet_page(
    server: Server, settings: PageSettings, hours_folder: Path | None = None, *, overview_s: float = OVERVIEW_S
) -> AsyncIterator[str]:
    """Serve the page while the context lasts.

    Args:
        server: Address of the fleet's server.
        settings: Address and access of the page.
        hours_folder: Folder of the Parquet files for queries; None: without queries.
        overview_s: Interval between two overviews [s].

    Yields:
        The page's address.

    Raises:
        UserError: A setting cannot be used, or the address is taken.
    """
    latest, view = LatestValues(), FleetView(PARTITIONS, time.monotonic())

    async def packs(request: web.Request) -> web.Response:
        return _json(view.packs.find(request.query.get("prefix", "")))

    async def pack(request: web.Request) -> web.Response:
        name = request.query.get("name", "")
        details = view.packs.details(name, time.monotonic())
        if details is None:
            raise web.HTTPNotFound(text="unknown pack\n")
        return _json(details)

    async with (
        WebServer(settings, FILES, latest, {"/packs": packs, "/pack": pack}, retry=False) as page,
        FleetFeed(server, view, latest.set_link_state),
    ):
        tasks = [asyncio.create_task(_send_overviews(view, latest, overview_s), name="fleet page")]
        if hours_folder is not None:
            tasks.append(asyncio.create_task(_send_query_results(hours_folder, latest), name="fleet queries"))
        try:
            yield page.url
        finally:
            await end_tasks(*tasks)


async def _send_overviews(view: FleetView, latest: LatestValues, overview_s: float) -> None:
    """Send an overview every ``overview_s``. Without a connection to the server the last overview stays on the page."""
    while True:
        if view.listening:
            latest.set_value(FLEET_KEY, view.overview_json(time.monotonic(), time.time()))
        await asyncio.sleep(overview_s)


async def _send_query_results(hours_folder: Path, latest: LatestValues) -> None:
    """Run the queries every ``QUERY_S``.

    A query of a large fleet takes seconds. The process ends only after it, because a thread cannot be cancelled.
    """
    while True:
        results = {name: await asyncio.to_thread(run_page_query, hours_folder, name) for name in PAGE_QUERIES}
        latest.set_value(ANSWERS_KEY, json.dumps(results, allow_nan=False, separators=(",", ":")))
        await asyncio.sleep(QUERY_S)


def _json(value: Any) -> web.Response:
    body = json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
    return web.Response(body=body, content_type="application/json", headers={"Cache-Control": "no-store"})
