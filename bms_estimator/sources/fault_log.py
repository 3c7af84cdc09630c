"""Faults of a line are logged at a limited rate, because junk may arrive for days."""

import math
from collections.abc import Mapping

import structlog

JUNK_LOG_S = 30.0
"""Faults are logged no more often than this [s]."""
_NO_FAULTS = ("bytes_received", "unadmitted_bytes", "frames_received", "before_hello", "reconnects", "retained")
"""Bytes and samples before the hello are usual where opening the port does not reset the board; so is a retained
message."""

log = structlog.get_logger(__name__)


class FaultLog:
    """Logs new faults."""

    def __init__(self) -> None:
        self._logged, self._logged_s = 0, -math.inf

    def check(self, counters: Mapping[str, int], now_s: float) -> None:
        """Look at the counters since start.

        Args:
            counters: Counts by kind.
            now_s: Monotonic clock [s].
        """
        counted = {name: n for name, n in counters.items() if name not in _NO_FAULTS and n}
        faults = sum(counted.values())
        if faults != self._logged and now_s - self._logged_s >= JUNK_LOG_S:
            self._logged, self._logged_s = faults, now_s
            log.warning("faults on the line", **counted)
