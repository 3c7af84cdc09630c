"""Time to the cut-off as text."""

import math

MIN_SHOWN_MEDIAN_S = 600.0
"""Minimum median time to the cut-off that is shown [s]. Below it only the band and the probability are shown, because a single
load peak may decide."""


CUTOFF_FIELDS = ("time_to_cutoff_s", "time_to_cutoff_p05_s", "time_to_cutoff_p95_s", "cutoff_within_5min")
"""Published fields that are the arguments of ``cutoff_text``."""


def cutoff_text(
    median_s: float | None, p05_s: float | None, p95_s: float | None, within_5min: float | None
) -> str | None:
    """Return the time to the cut-off with its 90 % band; None if it is unknown.

    For example ``1:52 h (1:20 to 2:31)``, or below ``MIN_SHOWN_MEDIAN_S`` ``3 to 9 min, 40 % within 5 min``.

    Args:
        median_s: Median of the time to the cut-off [s].
        p05_s: 5 % quantile of this time [s].
        p95_s: 95 % quantile of this time [s].
        within_5min: Probability of the cut-off within 5 min, 0..1.
    """
    if median_s is None or p05_s is None or p95_s is None:
        return None
    if median_s >= MIN_SHOWN_MEDIAN_S:
        return f"{clock_duration(median_s)} h ({clock_duration(p05_s)} to {clock_duration(p95_s)})"
    band = f"{p05_s / 60.0:.0f} to {p95_s / 60.0:.0f} min"
    return band if within_5min is None else f"{band}, {100.0 * within_5min:.0f} % within 5 min"


def clock_duration(duration_s: float) -> str:
    """Return hours and minutes, ``1:52``."""
    hours, minutes = divmod(math.floor(duration_s / 60.0 + 0.5), 60)
    return f"{hours}:{minutes:02d}"
