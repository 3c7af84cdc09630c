"""Silenced log, for commands that print themselves what the service would log."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import structlog


@contextmanager
def silenced_log() -> Iterator[None]:
    """Silence the log within the context."""
    previous_config = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        yield
    finally:
        structlog.configure(**previous_config)
