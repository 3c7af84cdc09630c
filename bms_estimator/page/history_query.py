"""Query of a pack's history for the curves of the page: a few hundred points, read in a thread."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.errors import UserError
from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.store.history import MINUTE_S
from bms_estimator.store.history_reader import HistoryReader

MAX_EVENTS = 50
"""Maximum number of events in a response; the latest are sent."""
MAX_CACHE_AGE_S = MINUTE_S / 2
"""Maximum age of a cached response [s]."""
FIELDS = (
    "time_s",
    "voltage_v",
    "voltage_min_v",
    "voltage_max_v",
    "current_a",
    "current_min_a",
    "current_max_a",
    "temperature_c",
    "soc",
    "soc_std",
    "energy_out_wh",
    "energy_in_wh",
)


class Span(NamedTuple):
    """Span and resolution of a query."""

    length_s: int
    step_s: int


SPANS = {"hour": Span(3600, MINUTE_S), "day": Span(86_400, 5 * MINUTE_S), "month": Span(30 * 86_400, 120 * MINUTE_S)}
"""Spans by name in the query, with 60, 288 and 360 points."""


class HistoryQuery:
    """Reader of histories with a cache. Each span is read at most once in ``MAX_CACHE_AGE_S``.

    Args:
        clock: Wall clock [s since 1970].
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._files: dict[str, Path] = {}
        self._cache: dict[tuple[str, str], tuple[float, bytes]] = {}  # read time and JSON, by pack and name of the span
        self._clock = clock
        self.thread = DaemonThreadExecutor("page")

    def add(self, pack: str, path: Path) -> None:
        """Register the file of a pack's history."""
        self._files[pack] = path

    def drop(self, pack: str) -> None:
        """Remove a pack."""
        self._files.pop(pack, None)
        for span in SPANS:
            self._cache.pop((pack, span), None)

    def read(self, pack: str, span: str) -> bytes:
        """Read a span of a pack's history as JSON columns; call it in ``thread``.

        Args:
            pack: Name of the pack.
            span: Name of a span, one of ``SPANS``.

        Raises:
            UserError: The file is missing or cannot be read.
        """
        if pack not in self._files:
            raise UserError(f"{pack}: no history is stored for this pack")
        now_s = self._clock()
        cached_s, text = self._cache.get((pack, span), (0.0, b""))
        if not 0.0 <= now_s - cached_s < MAX_CACHE_AGE_S:
            text = _query_columns(HistoryReader(self._files[pack]), SPANS[span], now_s)
            self._cache[pack, span] = now_s, text
        return text


def _query_columns(file: HistoryReader, span: Span, now_s: float) -> bytes:
    # the margin accepts samples whose clock is ahead
    since_s, until_s = now_s - span.length_s, now_s + MINUTE_S
    rows = file.rows(since_s, until_s, span.step_s)
    events = file.events(since_s, until_s)[-MAX_EVENTS:]
    columns = {field: [getattr(row, field) for row in rows] for field in FIELDS}
    payload = {"step_s": span.step_s, **columns, "events": [event._asdict() for event in events]}
    return json.dumps(payload, separators=(",", ":")).encode()
