"""Rate-limited log of a line's faults and of the reasons why no samples arrive, because noise may arrive for days."""

import math
from collections.abc import Mapping

import structlog

MIN_LOG_INTERVAL_S = 30.0
"""Minimum interval between two log lines on faults, or on one reason [s]."""
MAX_REASONS = 16
"""Maximum number of stored reasons. Noise in a device's text makes new reasons; the log of further ones is rate-limited."""
_NORMAL_EVENTS = (
    "bytes_received",
    "unadmitted_bytes",
    "frames_received",
    "before_hello",
    "reconnects",
    "retained",
    "missing",
)
"""Counters of normal events, which are not logged here.

Bytes and samples before the hello are normal if opening the port does not reset the board. Retained messages and messages
with only a part of the values are normal on MQTT. Sources log reconnects and rejected devices (``unadmitted_bytes``) themselves.
"""

_LOGGED_ONCE = {"implausible": "implausible_temperatures", "implausible_cells": "implausible_cell_voltages"}
"""Name in the log by counter. These counters are logged only once, because a device may send a placeholder with each sample."""

log = structlog.get_logger(__name__)


class FaultLog:
    """Log of a line's faults at a limited rate."""

    def __init__(self) -> None:
        self._logged_faults, self._log_time_s = 0, -math.inf

    def check(self, counters: Mapping[str, int], now_s: float, first_invalid: str = "") -> None:
        """Log the fault counters if they have changed and the minimum interval has passed.

        Args:
            counters: Counts since start, by name.
            now_s: Monotonic clock [s].
            first_invalid: Description of the first value that is no number; empty without one.
        """
        nonzero = {name: n for name, n in counters.items() if name not in _NORMAL_EVENTS and n}
        faults = sum(1 if name in _LOGGED_ONCE else n for name, n in nonzero.items())
        if faults != self._logged_faults and now_s - self._log_time_s >= MIN_LOG_INTERVAL_S:
            self._logged_faults, self._log_time_s = faults, now_s
            named = {_LOGGED_ONCE.get(name, name): n for name, n in nonzero.items()}
            log.warning("faults on the line", **named, **({"first": first_invalid} if first_invalid else {}))


class SilenceLog:
    """Log of the reasons why no samples arrive. Each reason is logged once until samples arrive, even if reasons alternate.

    The end of a logged silence is logged, too.
    """

    def __init__(self) -> None:
        self._logged_s: dict[str, float] = {}
        self._samples_s = -math.inf

    def on_samples(self, now_s: float) -> None:
        """Permit each reason to be logged again. ``now_s`` is the monotonic clock [s]."""
        if (
            max(self._logged_s.values(), default=-math.inf) > self._samples_s
        ):  # a reason was logged since the last samples
            log.info("samples arrive again")
        self._samples_s = now_s

    def report(self, reason: str, now_s: float) -> None:
        """Log a reason, unless it was logged since the last samples, or less than the minimum interval ago.

        Args:
            reason: Reason why no samples arrive.
            now_s: Monotonic clock [s].
        """
        logged_s = self._logged_s.get(reason, -math.inf)
        if logged_s > self._samples_s or now_s - logged_s < MIN_LOG_INTERVAL_S:
            return
        if len(self._logged_s) >= MAX_REASONS:
            if now_s - max(self._logged_s.values()) < MIN_LOG_INTERVAL_S:
                return
            del self._logged_s[next(iter(self._logged_s))]  # the oldest one
        self._logged_s[reason] = now_s
        log.warning("no samples", reason=reason)
