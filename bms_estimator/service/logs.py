"""Log lines: JSON for a journal or a pipe, readable on a terminal. On stderr; stdout belongs to results."""

import contextlib
import os
import sys
from collections.abc import Callable, MutableSequence
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
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso" if wide else "%H:%M:%SZ", utc=True),
            *last,
        ],
        logger_factory=lambda *_: _Lines(_print if lines is None else lines.append),
        cache_logger_on_first_use=True,
    )


def _print(message: str) -> None:
    """A line on stderr; where a full disk does not take it, it is lost and nothing else."""
    with contextlib.suppress(OSError):
        sys.stderr.write(f"{message}\n")
        sys.stderr.flush()


class _Lines:
    """A logger of structlog that hands on lines."""

    def __init__(self, take: Callable[[str], object]) -> None:
        self._take = take

    def msg(self, message: str) -> None:
        self._take(message)

    debug = info = warning = error = critical = exception = msg
