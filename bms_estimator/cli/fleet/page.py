"""``bms-estimator fleet page``: web page of all packs of a fleet."""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server
from bms_estimator.cli.options.pack_options import Browser, TokenFile, page_settings, serve
from bms_estimator.fleet.page import nats_feed
from bms_estimator.fleet.page.fleet_page import fleet_page
from bms_estimator.process.runtime import configure_logs, flush_logs
from bms_estimator.settings.connections import PageSettings

DEFAULT_LISTEN = "127.0.0.1:8080"
"""Default address of the page, host:port."""


def page(
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
    listen: Annotated[str, typer.Option(help="host:port of the page")] = DEFAULT_LISTEN,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="folder to which `fleet collect` writes, from which the page shows trends", show_default=False
        ),
    ] = None,
    token_file: TokenFile = None,
    host: Annotated[
        list[str] | None,
        typer.Option(help="further host name under which browsers request the page; repeatable", show_default=False),
    ] = None,
    browser: Browser = True,
) -> None:
    """Serve a web page of all packs of a fleet, until SIGINT, SIGTERM or SIGHUP."""
    settings = page_settings(PageSettings(), listen=listen, token_file=token_file, hosts=tuple(host or ()))
    configure_logs()
    with flush_logs():
        fleet = fleet_page(nats_feed.Server(server, creds, ca), settings, folder)
        asyncio.run(serve(fleet, "page of the fleet", browser=browser))
