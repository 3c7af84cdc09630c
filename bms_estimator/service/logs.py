"""Log lines: JSON for a journal or a pipe, readable on a terminal. Always on stderr; stdout belongs to results."""

import os
import sys
from typing import Any

import structlog


def configure_logs() -> None:
    """Set structlog up for this process."""
    readable = sys.stderr.isatty() and "JOURNAL_STREAM" not in os.environ
    last: list[Any] = (
        [structlog.dev.ConsoleRenderer()]
        if readable
        else [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            *last,
        ],
        logger_factory=structlog.PrintLoggerFactory(file=sys.stderr),
        cache_logger_on_first_use=True,
    )
