"""Log lines: JSON for a journal or a pipe, readable on a terminal. On stderr; stdout belongs to results."""

import os
import sys
from collections.abc import MutableSequence
from typing import Any

import structlog


def configure_logs(lines: MutableSequence[str] | None = None) -> None:
    """Set structlog up for this process.

    Args:
        lines: Gets the lines in place of stderr: a live view hides what else is written on its terminal.
    """
    readable = lines is not None or (sys.stderr.isatty() and "JOURNAL_STREAM" not in os.environ)
    wide = lines is None
    last: list[Any] = (
        [structlog.dev.ConsoleRenderer(30 if wide else 0, colors=wide, pad_level=wide)]
        if readable
        else [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso" if wide else "%H:%M:%SZ", utc=True),
            *last,
        ],
        logger_factory=structlog.PrintLoggerFactory(file=sys.stderr) if lines is None else lambda *_: _Lines(lines),
        cache_logger_on_first_use=True,
    )


class _Lines:
    """A logger of structlog that appends to a sequence."""

    def __init__(self, lines: MutableSequence[str]) -> None:
        self._append = lines.append

    def msg(self, message: str) -> None:
        self._append(message)

    debug = info = warning = error = critical = exception = msg
