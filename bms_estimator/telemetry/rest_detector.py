"""Detection of rest, a condition for the calibration of the current sensor's zero."""

from collections import deque

from bms_estimator.model.payloads.estimate import Estimate

REST_S = 30.0
"""Time for which current and voltage must have been constant [s]."""
MAX_CURRENT_FRACTION = 0.04
"""Maximum current at rest, as a fraction of the maximum current in the cell file. A sensor may have such an offset."""
MAX_VOLTAGE_STEPS = 2.0
"""Maximum range of the voltage at rest, in resolution steps (LSB) of the voltage."""


class RestDetector:
    """Detects rest from the means of the publish windows.

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
