"""What came of a demo, in a line."""

import time
from collections.abc import Callable
from typing import Self

from bms_estimator.model.payloads import Estimate, Snapshot
from bms_estimator.sinks.terminal.panels import BAND_STDS


class Totals:
    """A sink that remembers the last estimate, and how far it was from the truth.

    Args:
        first_error: Of the SOC that the estimator was told, 0..1.
        true_soc: The pack's SOC 0..1 at the last sample.
    """

    def __init__(self, first_error: float, true_soc: Callable[[], float]) -> None:
        self._first_error, self._true_soc = first_error, true_soc
        self._last: Estimate | None = None
        self._last_true_soc = 0.0
        self._started_s = time.monotonic()

    async def __aenter__(self) -> Self:
        """Nothing to open."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Nothing to close."""

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot."""
        if snapshot.estimate is not None:
            self._last, self._last_true_soc = snapshot.estimate, self._true_soc()

    def summary(self) -> str:
        """The run in a line."""
        e, elapsed_s = self._last, time.monotonic() - self._started_s
        if e is None or e.soc is None or e.soc_std is None:
            return f"{elapsed_s:.1f} s, no sample came"
        error, band = e.soc - self._last_true_soc, BAND_STDS * e.soc_std
        inside = "inside" if abs(error) <= band else "outside"
        return (
            f"{elapsed_s:.1f} s: {e.frames_received:,} frames, {e.frames_lost} lost, {e.crc_errors} CRC errors; "
            f"SOC at first {self._first_error:+.2%} wrong, at last {error:+.2%}: the truth {self._last_true_soc:.2%} lies "
            f"{inside} {e.soc:.2%} ± {band:.2%} (2 std); {'lock' if e.lock else 'no lock'}"
        )
