"""Samples at steps of the current whose voltage and current do not belong together.

Some cyclers write the first record of a step with the new current, but with the last voltage of the previous step. Others
measure the voltage after the current, so that the last record before a step already has the new voltage. Both records would
show a resistance of zero.
"""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.sample import SampleBlock

MIN_STEP = 0.1
"""Minimum change of the current at a step, as a fraction of the largest current."""
MAX_CURRENT_CHANGE = 0.1
"""Maximum change of the current between the mismatched sample and its neighbor with the same current, as a fraction of the
step."""
MAX_VOLTAGE_CHANGE = 0.05
"""Maximum change of the voltage at the step of the current, as a fraction of the response one sample earlier or later. A larger
change is the ohmic drop, so that voltage and current belong together."""
MIN_RATE_RATIO = 3.0
"""Minimum ratio of the response's rate of change to the rate of change in the next interval, or in the previous interval for an
early voltage. A steady fall of the voltage, as near empty, is not a delayed response."""
MIN_RESPONSE = 5.0
"""Minimum response of the voltage, in multiples of its median change between two samples, so that noise is not a response."""

MIN_SAMPLES = 4
"""Number of samples at a step: one before it, the mismatched one, and two after it."""


def are_mismatched(samples: SampleBlock) -> NDArray[np.bool_]:
    """Return which samples have the voltage of the other side of a step of the current. Shape (n,).

    Args:
        samples: Samples with finite values and increasing times, dtype ``SAMPLE``.
    """
    return np.asarray(_old_voltages(samples) | _early_voltages(samples))


def with_matched_voltages(samples: SampleBlock) -> SampleBlock:
    """Return the samples with the voltage of each mismatched one replaced by that of its neighbor with the same current.

    Args:
        samples: Samples as for ``are_mismatched``. They are returned without a copy if none is mismatched.
    """
    old, early = np.flatnonzero(_old_voltages(samples)), np.flatnonzero(_early_voltages(samples))
    if not old.size and not early.size:
        return samples
    matched = samples.copy()
    matched["voltage_v"][old], matched["voltage_v"][early] = (
        samples["voltage_v"][old + 1],
        samples["voltage_v"][early - 1],
    )
    return matched


def _early_voltages(samples: SampleBlock) -> NDArray[np.bool_]:
    """Return which samples have the current before a step and the voltage after it."""
    # backward in time, an early voltage is an old one
    return np.asarray(_old_voltages(samples[::-1])[::-1], dtype=np.bool_)


def _old_voltages(samples: SampleBlock) -> NDArray[np.bool_]:
    """Return which samples have the current after a step and the voltage before it."""
    if samples.size < MIN_SAMPLES:
        return np.zeros(samples.size, dtype=np.bool_)
    time_s, current_a, voltage_v = samples["time_s"], samples["current_a"], samples["voltage_v"]
    change_a, change_v, interval_s = np.diff(current_a), np.diff(voltage_v), np.abs(np.diff(time_s))
    step_a = change_a[:-2]
    response_v = -np.sign(step_a) * change_v[1:-1]  # a discharge is positive and lowers the voltage
    is_old = (
        (np.abs(step_a) > MIN_STEP * np.abs(current_a).max())
        & (np.abs(change_a[1:-1]) <= MAX_CURRENT_CHANGE * np.abs(step_a))
        & (np.abs(change_v[:-2]) <= MAX_VOLTAGE_CHANGE * response_v)
        & (response_v > MIN_RESPONSE * np.median(np.abs(change_v)))
        & (response_v * interval_s[2:] > MIN_RATE_RATIO * np.abs(change_v[2:]) * interval_s[1:-1])
    )
    return np.concatenate([[False], is_old, [False, False]])
