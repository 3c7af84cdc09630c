"""State of the service for the topic ``health``, and the latency of its blocks."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from bms_estimator.model.payloads.health import EdgeHealth, HookHealth, RecordingHealth
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.sources.source import SourceHealth
from bms_estimator.telemetry.health import NO_FIT, FitTimes
from bms_estimator.telemetry.publish_window import ChargeEnergy

MIN_LATENCY_S = 1e-5
"""Upper edge of the first bin [s]."""
BINS_PER_OCTAVE = 4
"""Number of bins per doubling of the latency, so that each bin is a fifth wider than the previous one."""
BINS = 100
"""Number of bins; the last one begins at four minutes."""


class LatencyHistogram:
    """Histogram of latencies in logarithmic bins, so that adding a value is cheap."""

    def __init__(self) -> None:
        self._counts = [0] * BINS
        self._max_s = 0.0

    def add(self, latency_s: float) -> None:
        """Add a latency [s]."""
        octaves = math.log2(max(latency_s, MIN_LATENCY_S) / MIN_LATENCY_S)
        self._counts[min(math.ceil(BINS_PER_OCTAVE * octaves), BINS - 1)] += 1
        self._max_s = max(self._max_s, latency_s)

    def pop_summary(self) -> tuple[float, float, float] | None:
        """Return median, 99th percentile and maximum since the last reset [s], and reset them; None without a value.

        The percentiles are overestimated by up to a fifth, the width of a bin.
        """
        counts, max_s = self._counts, self._max_s
        self._counts, self._max_s = [0] * BINS, 0.0
        if not any(counts):
            return None
        return _percentile(counts, 0.5, max_s), _percentile(counts, 0.99, max_s), max_s


def _percentile(counts: list[int], fraction: float, max_s: float) -> float:
    """Return the upper edge of the percentile's bin, or the maximum [s]."""
    rank, cumulative = fraction * sum(counts), 0
    for i, count in enumerate(counts):
        cumulative += count
        if cumulative >= rank:
            return min(MIN_LATENCY_S * math.exp2(i / BINS_PER_OCTAVE), max_s)
    return max_s


@dataclass
class ServiceStatus:
    """Reports of the parts of the service. Each part writes its own fields."""

    delivery: DeliveryStats = field(default_factory=DeliveryStats)
    """Counters of sent messages and received requests."""
    source_health: Callable[[], SourceHealth] | None = None
    """Returns the health of the source; None: not reported."""
    recording: Callable[[], RecordingHealth | None] = lambda: None
    """Returns the state of a recording; None where nothing is recorded."""
    edge: Callable[[], EdgeHealth | None] = lambda: None
    """Returns the state of the fleet edge; None without one."""
    hooks: Callable[[], HookHealth | None] = lambda: None
    """Returns successes and failures of alarm hooks; None without hooks."""
    fit_times: Callable[[], FitTimes] = lambda: NO_FIT
    """Returns end and duration of the last fit."""
    restarts: int = 0
    """Number of starts that found files of an earlier run."""
    contradictions: Sequence[str] = ()
    """Settings that the values of the device contradict, one line each."""
    checkpoint: str = "off"
    """Outcome of the last restore or save of a checkpoint."""
    disk_free_mib: float | None = None
    """Free space in the state folder [MiB]."""
    log_lines_lost: int = 0
    """Number of log lines dropped since start."""
    saved_charge_energy: ChargeEnergy | None = None
    """Saved charge and energy; None if they are not saved."""
