"""Quality of a capture's data: gaps, clock, missing values and resolution."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.charge_count import gap_s

ROUNDING_FRACTION = 1e-6
"""Difference of two values that counts as rounding, as a fraction of the largest magnitude."""


@dataclass(frozen=True)
class DataQuality:
    """Quality of a capture's data.

    Attributes:
        samples: Number of samples.
        duration_s: Time from the first to the last sample [s].
        period_s: Median time between two samples [s]; NaN for fewer than two.
        period_percentiles_s: 1st and 99th percentile of the time between two samples [s].
        gaps: Number of intervals longer than ``charge_count.gap_s``.
        longest_gap_s: Longest interval between two samples [s].
        backward_steps: Number of samples whose time is before the previous sample's time.
        repeated_times: Number of samples with the time of the previous sample.
        not_finite: Number of samples without a finite time, current or voltage.
        temperature_fraction: Fraction of samples with a temperature, 0..1.
        voltage_resolution_v: Smallest difference between two different voltages [V]; NaN for a constant voltage.
        current_resolution_a: Smallest difference between two different currents [A]; NaN for a constant current.
    """

    samples: int
    duration_s: float
    period_s: float
    period_percentiles_s: tuple[float, float]
    gaps: int
    longest_gap_s: float
    backward_steps: int
    repeated_times: int
    not_finite: int
    temperature_fraction: float
    voltage_resolution_v: float
    current_resolution_a: float


def data_quality(samples: SampleBlock) -> DataQuality:
    """Return the quality of samples of dtype ``SAMPLE``, as they were read."""
    valid = np.isfinite(samples["time_s"]) & np.isfinite(samples["current_a"]) & np.isfinite(samples["voltage_v"])
    time_s = samples["time_s"][valid]
    step_s = np.diff(time_s)
    forward_s = step_s[step_s > 0.0]
    period_s = float(np.median(forward_s)) if forward_s.size else float("nan")
    short_s, long_s = np.percentile(forward_s, (1.0, 99.0)) if forward_s.size else (np.nan, np.nan)
    return DataQuality(
        samples=samples.size,
        duration_s=float(time_s.max() - time_s.min()) if time_s.size else 0.0,
        period_s=period_s,
        period_percentiles_s=(float(short_s), float(long_s)),
        gaps=int(np.count_nonzero(step_s > gap_s(step_s))),
        longest_gap_s=float(forward_s.max(initial=0.0)),
        backward_steps=int(np.count_nonzero(step_s < 0.0)),
        repeated_times=int(np.count_nonzero(step_s == 0.0)),
        not_finite=int(samples.size - np.count_nonzero(valid)),
        temperature_fraction=float(np.isfinite(samples["temperature_c"]).mean()) if samples.size else 0.0,
        voltage_resolution_v=_resolution(samples["voltage_v"][valid]),
        current_resolution_a=_resolution(samples["current_a"][valid]),
    )


def _resolution(values: Floats) -> float:
    """Return the smallest difference between two different values; NaN if all are equal."""
    differences = np.diff(np.unique(values))
    significant = differences[differences > ROUNDING_FRACTION * np.abs(values).max(initial=0.0)]
    return float(significant.min()) if significant.size else float("nan")
