"""Options of commands that serve a page or read a serial port."""

import os
import sys
import threading
import webbrowser
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from bms_estimator.model.config_file import error_reason
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import stop_on_signal
from bms_estimator.settings.page import PageSettings
from bms_estimator.sources.serial.port_list import named_ports


def complete_port(incomplete: str) -> list[str]:
    """Return the connected serial ports whose names begin with ``incomplete``."""
    return [name for name in named_ports() if name.startswith(incomplete)]


PortOverride = Annotated[
    str | None,
    typer.Option(help="serial port that replaces sensor.port of the settings", autocompletion=complete_port),
]
"""Option that replaces the serial port of the settings."""


TokenFile = Annotated[Path | None, typer.Option(help="file with the access token of the page", show_default=False)]
Browser = Annotated[
    bool, typer.Option("--browser/--no-browser", help="open the page in a browser if there is a desktop")
]

DESKTOP_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY")
"""Environment variables of which a desktop session sets at least one."""


def page_settings(settings: PageSettings, **options: Any) -> PageSettings:
    """Return the settings of a page, changed by options of the command line; None leaves a setting unchanged.

    Raises:
        UserError: The address to listen on is invalid, or is open to other machines and there is no token file.
    """
    given = {name: value for name, value in options.items() if value is not None}
    try:
        return PageSettings.model_validate(settings.model_dump() | given)
    except ValidationError as error:
        reason = error_reason(error.errors()[0])
        raise UserError(f"--listen {given.get('listen', settings.listen)}: {reason}") from None


def open_browser(url: str) -> None:
    """Open ``url`` in a browser if the user works on a desktop.

    The browser is opened in a thread, because some browsers block until they are closed.
    """
    if not sys.stdout.isatty() or not any(os.environ.get(name) for name in DESKTOP_VARIABLES):
        return
    threading.Thread(target=webbrowser.open, args=[url], name="browser", daemon=True).start()


async def serve(page: AbstractAsyncContextManager[str], name: str, *, browser: bool) -> None:
    """Serve a page, which yields its address, until a signal.

    Args:
        page: The page.
        name: Description of the page, printed before its address.
        browser: Open the page in a browser.
    """
    stop = stop_on_signal()
    async with page as url:
        typer.echo(f"{name}: {url}")
        if browser:
            open_browser(url)
        await stop.wait()
