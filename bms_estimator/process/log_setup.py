"""Log lines: JSON for a journal or a pipe, readable on a terminal. On stderr; stdout belongs to results."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, MutableMapping, MutableSequence
from typing import Any, get_args

import structlog

from bms_estimator.process.stderr_writer import stderr
from bms_estimator.settings.pack import LogLevel

LEVELS: tuple[LogLevel, ...] = get_args(LogLevel)
_levels: dict[str, LogLevel] = {}
"""Log levels by pack."""


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
            _talkative,
            structlog.processors.TimeStamper(fmt="iso" if wide else "%H:%M:%SZ", utc=True),
            *last,
        ],
        logger_factory=lambda *_: _Lines(stderr.take if lines is None else lines.append),
    )


@contextlib.contextmanager
def flush_logs() -> Iterator[None]:
    """Write the log before the command line prints an error."""
    try:
        yield
    finally:
        stderr.drain()


def set_level(pack: str, level: LogLevel) -> None:
    """Set a pack's minimum log level; a process with several packs uses the lowest of them."""
    _levels[pack] = level


def _talkative(_: object, __: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Drop lines below the level.

    Raises:
        structlog.DropEvent: It is.
    """
    least = min((LEVELS.index(level) for level in _levels.values()), default=0)
    if line["level"] in LEVELS and LEVELS.index(line["level"]) < least:
        raise structlog.DropEvent
    return line


class _Lines:
    """A logger of structlog that hands on lines."""

    def __init__(self, take: Callable[[str], object]) -> None:
        self._take = take

    def msg(self, message: str) -> None:
        self._take(message)

    debug = info = warning = error = critical = exception = msg
