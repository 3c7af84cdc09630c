"""Options of commands that serve a page."""

import os
import sys
import threading
import webbrowser
from typing import Any

from pydantic import ValidationError

from bms_estimator.model.errors import UserError
from bms_estimator.settings.page import PageSettings

DESKTOP = ("DISPLAY", "WAYLAND_DISPLAY")
"""Environment variables of a desktop session."""


def page_settings(settings: PageSettings, **options: Any) -> PageSettings:
    """Return the settings with the page's options of the command line.

    Raises:
        UserError: An option is invalid.
    """
    given = {name: value for name, value in options.items() if value is not None}
    try:
        return PageSettings.model_validate(settings.model_dump() | given)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise UserError(f"--listen {given.get('listen', settings.listen)}: {reason}") from None


def open_browser(url: str) -> None:
    """Open ``url`` in a desktop's browser, in a thread, because some browsers block until they are closed."""
    if not sys.stdout.isatty() or not any(os.environ.get(name) for name in DESKTOP):
        return
    threading.Thread(target=webbrowser.open, args=[url], name="browser", daemon=True).start()
