"""Sums over the samples since the last publication, and detection of rest from the means of these publish windows.

Rest is a condition for the calibration of the current sensor's zero.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.accumulators.publish_window import WINDOW_SUMS, accumulate_window
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.sample import NO_CELLS, NO_PROBES, CellBlock, ProbeBlock

REST_S = 30.0
"""Time for which current and voltage must have been constant [s]."""
MAX_CURRENT_FRACTION = 0.04
"""Maximum current at rest, as a fraction of the maximum current in the cell file. A sensor may have such an offset."""
MAX_VOLTAGE_STEPS = 2.0
"""Maximum range of the voltage at rest, in resolution steps (LSB) of the voltage."""


class RestDetector:
    """Detector of rest from the means of the publish windows.

    Args:
        current_max_a: Maximum current of the pack [A].
        voltage_resolution_v: Resolution (LSB) of the voltage [V].
    """

    def __init__(self, current_max_a: float, voltage_resolution_v: float) -> None:
        self._max_current_a, self._max_change_v = (
            MAX_CURRENT_FRACTION * current_max_a,
            MAX_VOLTAGE_STEPS * voltage_resolution_v,
        )
        self._windows: deque[tuple[float, float, float]] = deque()  # monotonic time [s], current [A], voltage [V]

    def add(self, estimate: Estimate, now_s: float) -> None:
        """Add the estimate of a publish window; ``now_s`` is the monotonic clock [s]."""
        self._windows.append((now_s, estimate.current_a, estimate.voltage_v))
        while len(self._windows) > 1 and now_s - self._windows[1][0] >= REST_S:
            self._windows.popleft()

    def reset(self) -> None:
        """Restart the detection after a gap in the samples."""
        self._windows.clear()

    def not_at_rest_reason(self, now_s: float) -> str | None:
        """Return the reason why the pack may not be at rest; None when it is at rest.

        Args:
            now_s: Monotonic clock [s].
        """
        watched_s = now_s - self._windows[0][0] if self._windows else 0.0
        if watched_s < REST_S:
            return f"the pack was watched for {watched_s:.0f} s only; wait until it is {REST_S:.0f} s"
        _, currents_a, voltages_v = zip(*self._windows, strict=True)
        current_a = max(currents_a, key=abs)
        if abs(current_a) > self._max_current_a:
            return (
                f"current flows: {current_a:.3g} A within the last {REST_S:.0f} s; at most {self._max_current_a:.3g} A"
            )
        moved_v = max(voltages_v) - min(voltages_v)
        if moved_v > self._max_change_v:
            return f"current flows: the voltage moved by {moved_v:.3g} V within the last {REST_S:.0f} s"
        return None


@dataclass(frozen=True)
class WindowSummary:
    """Means over one publish window, and its last trace row.

    Attributes:
        arrival_s: Wall clock at the arrival of the last block [s since 1970].
        samples: Number of samples.
        voltage_v: Mean voltage [V].
        current_a: Mean current [A], positive on discharge.
        power_w: Mean power [W].
        temperature_c: Mean temperature [C], NaN without a sensor.
        sample_rate_hz: Sample rate on the clock of the samples [Hz], NaN if unknown.
        last: Last row, dtype TRACE.
        soc_known: True if the SOC is known at the last row.
        cells_v: Last cell voltages [V], shape (m,), NaN if not reported; m is 0 without cell voltages.
        probes: Last temperature probes, shape (m,), dtype PROBE; m is 0 without a list of them.
    """

    arrival_s: float
    samples: int
    voltage_v: float
    current_a: float
    power_w: float
    temperature_c: float
    sample_rate_hz: float
    last: np.void
    soc_known: bool
    cells_v: NDArray[np.float64]
    probes: ProbeBlock


class Window:
    """Sums over trace blocks since the last publication.

    Attributes:
        previous_end_s: Last time stamp of the previous window [s]; NaN before the first window.
        soc_known: True if the SOC is known at the last row of this window or an earlier one.
    """

    def __init__(self) -> None:
        self.previous_end_s, self.soc_known = math.nan, False
        self._sums: NDArray[np.void] = np.zeros(1, dtype=WINDOW_SUMS)
        self._clear()

    def _clear(self) -> None:
        self._sums.fill(0)
        self._last: np.void | None = None
        self._arrival_s = math.nan
        self._cells, self._probes = NO_CELLS, NO_PROBES

    def add(
        self, trace: TraceBlock, arrival_s: float, cells: CellBlock = NO_CELLS, probes: ProbeBlock = NO_PROBES
    ) -> None:
        """Add the trace of one block.

        Args:
            trace: Accepted samples, shape (n,), dtype TRACE; n may be 0.
            arrival_s: Wall clock at the arrival of the block [s since 1970].
            cells: Cell voltages of the block.
            probes: Temperature probes of the block.
        """
        if cells.size:
            self._cells = cells[-1:]
        if probes.size:
            self._probes = probes[-1:]
        if trace.size:
            self.soc_known = accumulate_window(self._sums, trace, self.soc_known)
            # a copy of the record would copy field by field, which takes longer than the sums
            self._last = np.frombuffer(trace[-1:].tobytes(), trace.dtype)[0]
        self._arrival_s = arrival_s

    def take(self) -> WindowSummary | None:
        """Return the summary of the samples since the last call, and begin a new window. Return None without a sample."""
        if self._last is None:
            return None
        n, first_s, voltage, current, power, temperature_count, temperature = self._sums[0].item()
        last_s = float(self._last["time_s"])
        # the window begins at the last sample of the previous window, or at its own first sample
        steps, begin_s = (n, self.previous_end_s) if math.isfinite(self.previous_end_s) else (n - 1, first_s)
        span_s = last_s - begin_s
        summary = WindowSummary(
            arrival_s=self._arrival_s,
            samples=n,
            voltage_v=voltage / n,
            current_a=current / n,
            power_w=power / n,
            temperature_c=temperature / temperature_count if temperature_count else math.nan,
            sample_rate_hz=steps / span_s if span_s > 0.0 else math.nan,
            last=self._last,
            soc_known=self.soc_known,
            cells_v=self._cells.ravel(),
            probes=self._probes.ravel(),
        )
        self.previous_end_s = last_s
        self._clear()
        return summary
