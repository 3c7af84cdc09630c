"""A browser on a page of ours, where somebody sits before the machine."""

import os
import sys
import threading
import webbrowser

DESKTOP = ("DISPLAY", "WAYLAND_DISPLAY")


def open_browser(url: str) -> None:
    """Open ``url`` in a desktop's browser, in a thread: some browsers return only when they end."""
    if not sys.stdout.isatty() or not any(os.environ.get(name) for name in DESKTOP):
        return
    threading.Thread(target=webbrowser.open, args=[url], name="browser", daemon=True).start()
