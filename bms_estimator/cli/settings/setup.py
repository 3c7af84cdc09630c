"""``bms-estimator setup``: the wizard as a web page."""

import asyncio
import os
import secrets
from collections import deque
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import Browser, TokenFile, open_browser, page_settings, whole
from bms_estimator.process.runtime import configure_logs, stop_on_signal
from bms_estimator.settings.connections import DEFAULT_LISTEN, PageSettings
from bms_estimator.settings.pack import require_new
from bms_estimator.setup.page.setup_server import SetupServer


def setup(
    file: Annotated[Path, typer.Argument(help="settings file to create")] = Path("pack.toml"),
    port: Annotated[
        int | None,
        typer.Option(
            parser=whole(0, 65535),
            help="port of the page on this machine; 0: any free port; default: 8765",
            show_default=False,
        ),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(
            help=f"host:port of the page, for other machines; requires --token-file; default: {DEFAULT_LISTEN}",
            show_default=False,
        ),
    ] = None,
    token_file: TokenFile = None,
    browser: Browser = True,
) -> None:
    """Serve a web page with the questions of `bms-estimator new`, until Ctrl-C."""
    require_new(file)
    address = listen if port is None else f"127.0.0.1:{port}"
    page = page_settings(PageSettings(), listen=address, token_file=token_file)
    configure_logs(deque[str](maxlen=1))  # the page reports faults itself
    # without a token, every user of this machine could run root's wizard
    token = secrets.token_hex(16) if os.geteuid() == 0 and page.token_file is None else None
    asyncio.run(_serve(page, file, token, browser=browser))


async def _serve(page: PageSettings, file: Path, token: str | None, *, browser: bool) -> None:
    stop = stop_on_signal()
    async with SetupServer(page, file, token) as server:
        typer.echo(f"setup page: {server.url}{f'?token={token}' if token else ''}")
        if browser:
            open_browser(server.url)  # the token would be visible in the arguments of the browser's process
        await stop.wait()
