"""Configuration of the log on stderr: JSON for a journal or a pipe, readable text on a terminal."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, MutableMapping, MutableSequence
from typing import Any, get_args

import structlog
from structlog.processors import ExceptionRenderer
from structlog.tracebacks import ExceptionDictTransformer

from bms_estimator.process.stderr_writer import stderr
from bms_estimator.settings.pack import LogLevel

LEVELS: tuple[LogLevel, ...] = get_args(LogLevel)
_levels: dict[str, LogLevel] = {}
"""Log levels by pack."""
_exception_as_dicts = ExceptionRenderer(ExceptionDictTransformer(show_locals=False))
"""Processor that converts an exception to dicts for JSON."""


def configure_logs(lines: MutableSequence[str] | None = None) -> None:
    """Configure structlog for this process.

    Args:
        lines: List that receives the lines in place of stderr, for a live view that uses the terminal itself.
    """
    readable = lines is not None or (sys.stderr.isatty() and "JOURNAL_STREAM" not in os.environ)
    to_stderr = lines is None
    # tracebacks without local variables, which may contain a password
    renderers: list[Any] = (
        [
            structlog.dev.ConsoleRenderer(
                30 if to_stderr else 0,  # width of the event
                colors=to_stderr,
                pad_level=to_stderr,
                exception_formatter=structlog.dev.plain_traceback,
            )
        ]
        if readable
        else [_exception_as_dicts, structlog.processors.JSONRenderer()]
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            _drop_below_level,
            structlog.processors.TimeStamper(fmt="iso" if to_stderr else "%H:%M:%SZ", utc=True),
            *renderers,
        ],
        logger_factory=lambda *_: _LineLogger(stderr.put if lines is None else lines.append),
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


def _drop_below_level(_: object, __: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Drop lines below the level.

    Raises:
        structlog.DropEvent: The line is below the level.
    """
    min_level = min((LEVELS.index(level) for level in _levels.values()), default=0)
    if line["level"] in LEVELS and LEVELS.index(line["level"]) < min_level:
        raise structlog.DropEvent
    return line


class _LineLogger:
    """Logger of structlog that passes lines to a function."""

    def __init__(self, write_line: Callable[[str], object]) -> None:
        self._write_line = write_line

    def msg(self, message: str) -> None:
        self._write_line(message)

    debug = info = warning = error = critical = exception = msg
