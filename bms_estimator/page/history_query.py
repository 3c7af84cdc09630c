"""Query of a pack's history for the curves of the page: a few hundred points, read in a thread."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.errors import UserError
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.store.history_reader import HistoryFile
from bms_estimator.store.minute import MINUTE_S

MAX_EVENTS = 50
"""Maximum number of events in a response; the latest are sent."""
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
    """Reader of histories with a cache. Each span is read at most every half minute.

    Args:
        clock: Wall clock [s since 1970].
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._files: dict[str, Path] = {}
        self._read: dict[tuple[str, str], tuple[float, bytes]] = {}
        self._clock = clock
        self.thread = DiskThread("page")

    def add(self, pack: str, path: Path) -> None:
        """Register the file of a pack's history."""
        self._files[pack] = path

    def drop(self, pack: str) -> None:
        """Remove a pack."""
        self._files.pop(pack, None)
        for name in SPANS:
            self._read.pop((pack, name), None)

    def read(self, pack: str, name: str) -> bytes:
        """Read a span of a pack's history as JSON columns; call it in ``thread``.

        Args:
            pack: Name of the pack.
            name: One of ``SPANS``.

        Raises:
            UserError: The file is missing or cannot be read.
        """
        if pack not in self._files:
            raise UserError(f"{pack}: there is no history here")
        now_s = self._clock()
        read_s, text = self._read.get((pack, name), (0.0, b""))
        if not 0.0 <= now_s - read_s < MINUTE_S / 2:
            text = _columns(HistoryFile(self._files[pack]), SPANS[name], now_s)
            self._read[pack, name] = now_s, text
        return text


def _columns(file: HistoryFile, span: Span, now_s: float) -> bytes:
    since_s, until_s = now_s - span.length_s, now_s + MINUTE_S
    rows = file.rows(since_s, until_s, span.step_s)
    events = file.events(since_s, until_s)[-MAX_EVENTS:]
    columns = {field: [getattr(row, field) for row in rows] for field in FIELDS}
    payload = {"step_s": span.step_s, **columns, "events": [event._asdict() for event in events]}
    return json.dumps(payload, separators=(",", ":")).encode()
