"""A capture without glitches, prepared for calibration: coulomb counting by (2.1) of the thesis, and detection of rests.

Glitches include samples at steps of the current whose voltage and current do not belong together. Some cyclers write the first record of a step with the new current, but with the last voltage of the previous step. Others
measure the voltage after the current, so that the last record before a step already has the new voltage. Both records would
show a resistance of zero.
"""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats, Masks, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.model.charge_count import charge_ah
from bms_estimator.model.errors import UserError

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


def are_mismatched(samples: SampleBlock) -> Masks:
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


def _early_voltages(samples: SampleBlock) -> Masks:
    """Return which samples have the current before a step and the voltage after it."""
    # backward in time, an early voltage is an old one
    return np.asarray(_old_voltages(samples[::-1])[::-1], dtype=np.bool_)


def _old_voltages(samples: SampleBlock) -> Masks:
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


GLITCH_FRACTION = 0.5
"""Maximum deviation of a voltage from the median, as a fraction of the median. A larger deviation is a fault of the
instrument, because no Li-ion cell has such a range."""
MAX_BACKWARD_FRACTION = 0.1
"""Maximum fraction of samples whose timestamp is lower than an earlier timestamp. A small correction of a clock causes few
such samples."""
MIN_PLAUSIBLE_FRACTION = 0.5
"""Minimum fraction of good voltages. With fewer, the median may be a glitch, so that glitches are not
recognized."""
REST_C_RATE = 0.01
"""Maximum C-rate of a rest [1/h]. It changes SOC by only 0.25 % in a rest of 15 min."""
NOISE_STDS = 6.0
"""Maximum current of a rest, in standard deviations of the current's noise."""
NOISE_STEP_C_RATE = 0.1
"""Changes of the current between two samples below this C-rate [1/h] count as noise, larger ones as load."""
MIN_LOAD_CHARGE = 2e-5
"""Minimum charge of a load that interrupts a rest, as a fraction of the capacity: 1 C for 72 ms. Less is a glitch of the
sensor."""
SOC_SLACK = 0.03
"""Tolerance of the counted SOC outside 0..1, because the capacities of cells of one type differ by as much."""


def remove_glitches(samples: SampleBlock, name: str) -> SampleBlock:
    """Return the samples that are finite, later than all samples before, and within 50 % of the median voltage.

    The median is taken over the voltages above 0 V.

    Raises:
        UserError: Nothing is left, most voltages are glitches, or the time goes back.
    """
    finite = np.isfinite(samples["time_s"]) & np.isfinite(samples["current_a"]) & np.isfinite(samples["voltage_v"])
    good = select_samples(samples, finite)
    if good.size == 0:
        raise UserError(f"{name}: none of {samples.size} samples has finite time, current and voltage")
    positive_v = good["voltage_v"][good["voltage_v"] > 0.0]
    if positive_v.size == 0:
        raise UserError(
            f"{name}: none of {samples.size} samples has a voltage above 0 V, the largest is {good['voltage_v'].max():g} V"
        )
    median_v = float(np.median(positive_v))
    is_glitch = np.abs(good["voltage_v"] - median_v) > GLITCH_FRACTION * median_v
    if is_glitch.mean() > 1.0 - MIN_PLAUSIBLE_FRACTION:
        first = good[int(np.argmax(is_glitch))]
        raise UserError(
            f"{name}: {is_glitch.sum()} of {samples.size} samples are glitches, the first at {first['time_s']:.0f} s with "
            f"{first['voltage_v']:.3f} V where the median is {median_v:.3f} V: check the sensor's wiring"
        )
    good = select_samples(good, ~is_glitch)
    latest = np.maximum.accumulate(good["time_s"])
    is_earlier = good["time_s"] < latest
    if is_earlier.mean() > MAX_BACKWARD_FRACTION:
        first = int(np.argmax(is_earlier))
        raise UserError(
            f"{name}: time goes back {(np.diff(good['time_s']) < 0.0).sum()} times, first from {latest[first]:g} to "
            f"{good['time_s'][first]:g} s, and {is_earlier.sum()} of {samples.size} samples are earlier than one before them: the file "
            "contains several captures, or a clock was set; give each stretch as a file of its own"
        )
    is_later = np.r_[True, good["time_s"][1:] > latest[:-1]]
    return select_samples(good, is_later)


def select_samples(samples: SampleBlock, mask: Masks) -> SampleBlock:
    """Return the samples for which ``mask`` is True: ``samples`` itself if all are, because a long capture is large."""
    return samples if mask.all() else samples[mask]


def soc_by_counting(samples: SampleBlock, capacity_ah: float, initial_soc: float = 1.0) -> Floats:
    """Return SOC at every sample by coulomb counting, (2.1). Shape (n,), not limited to 0..1.

    ``charge_ah`` integrates the current, which counts as 0 in gaps of more than an hour.
    """
    return initial_soc - charge_ah(samples["time_s"], samples["current_a"]) / capacity_ah


def resting_samples(good: SampleBlock, capacity_ah: float) -> Masks:
    """Return which samples belong to a rest. Short glitches of the current sensor do not end a rest."""
    resting: Masks = np.abs(good["current_a"]) < rest_current_a(good["current_a"], capacity_ah)
    time_s = good["time_s"]
    for first, last in true_runs(~resting):
        until_s = time_s[min(last, good.size - 1)]
        load_ah = abs(float(good["current_a"][first:last].mean())) * (until_s - time_s[first]) / 3600.0
        if load_ah < MIN_LOAD_CHARGE * capacity_ah:
            resting[first:last] = True
    return resting


def rest_current_a(current_a: Floats, capacity_ah: float) -> float:
    """Return the maximum current of a rest [A]: a small C-rate or the sensor's noise, limited to half of the load."""
    change_a = np.diff(current_a)
    small_a = change_a[np.abs(change_a) < NOISE_STEP_C_RATE * capacity_ah]
    noise_a = float(np.sqrt(np.mean(small_a**2) / 2.0)) if small_a.size else 0.0  # a difference has twice the variance
    # a periodic load must not count as noise: the limit is below half of the 95th percentile of the current
    half_load_a = 0.5 * float(np.quantile(np.abs(current_a), 0.95))
    return max(REST_C_RATE * capacity_ah, min(NOISE_STDS * noise_a, half_load_a))


def true_runs(mask: Masks) -> list[tuple[int, int]]:
    """Return the runs of True in ``mask``, each as (first index, index after the last)."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def mean_temperature_c(samples: SampleBlock) -> float:
    """Return the mean of the reported temperatures [C]; NaN without a sensor."""
    reported_c = samples["temperature_c"][np.isfinite(samples["temperature_c"])]
    return float(reported_c.mean()) if reported_c.size else float("nan")


NEIGHBORS = 2
"""Number of neighbors on each side of a sample. A sample is compared with the median of itself and its neighbors."""
WINDOW_SAMPLES = 2 * NEIGHBORS + 1
"""Number of samples in the median, and minimum number of good samples of a capture."""
SPIKE_V = 0.03
"""Maximum deviation of a voltage from its neighbors' median that the current does not explain, per cell [V]."""
SPIKE_C = 0.1
"""Maximum deviation of a current from its neighbors' median while the voltage stays constant, as C-rate [1/h]."""
RESISTANCE_FACTOR = 3.0
"""Largest plausible voltage change per ampere, in multiples of the series resistance at SOC 0.5."""
UNCHANGED_FRACTION = 0.01
"""A jump of the current is a spike if the voltage changes by less than this fraction of the jump times the largest
resistance."""
BLOCK_SAMPLES = 1 << 16
"""Number of samples whose medians are computed at once. It limits the memory of long captures."""
MIN_GOOD_FRACTION = 0.5
"""Minimum fraction of samples within the limits of the cell. A smaller fraction means that the cell file is of another
cell."""


@dataclass(frozen=True)
class CleanCapture:
    """Capture without glitches.

    Attributes:
        name: Name for messages.
        time_s: Shape (n,), increasing, from 0 [s].
        current_a: Shape (n,), positive on discharge [A].
        voltage_v: Shape (n,), measured [V].
        temperature_c: Shape (n,), temperature of the cell [C]; NaN where it was not measured.
        discharged_ah: Shape (n,), charge drawn since the first sample [Ah].
        mismatched: Shape (n,), True where the voltage was measured before a step of the current and the current after it, or vice
            versa (``are_mismatched``). The current of such a sample counts as charge. Its voltage is replaced by that of a
            neighbor, and determines no resistance.
        resting_samples: Number of samples at rest before the first load; 0 if the capture starts under load.
        samples: Number of samples of the original capture, with glitches.
        glitches: Number of dropped glitches.
    """

    name: str
    time_s: Floats
    current_a: Floats
    voltage_v: Floats
    temperature_c: Floats
    discharged_ah: Floats
    mismatched: Masks
    resting_samples: int
    samples: int
    glitches: int

    @property
    def start_v(self) -> float:
        """Median voltage of the first rest [V]; the voltage of the first sample if the capture starts under load."""
        return float(np.median(self.voltage_v[: max(self.resting_samples, 1)]))


def clean_capture(name: str, samples: SampleBlock, cell: CellModel) -> CleanCapture:
    """Return the good samples of a capture.

    Raises:
        UserError: Too few good samples, or most samples lie outside the cell's limits.
    """
    good = _without_spikes(_within_limits(name, remove_glitches(samples, name), cell), cell)
    time_s = np.ascontiguousarray(good["time_s"] - good["time_s"][0])
    current_a = np.ascontiguousarray(good["current_a"])
    resting = np.abs(current_a) < REST_C_RATE * cell.cell.capacity_ah
    return CleanCapture(
        name=name,
        time_s=time_s,
        current_a=current_a,
        voltage_v=np.ascontiguousarray(with_matched_voltages(good)["voltage_v"]),
        temperature_c=np.ascontiguousarray(good["temperature_c"]),
        discharged_ah=charge_ah(time_s, current_a),
        mismatched=are_mismatched(good),
        resting_samples=int(np.argmin(resting)) if not resting.all() else resting.size,
        samples=samples.size,
        glitches=samples.size - good.size,
    )


def _within_limits(name: str, samples: SampleBlock, cell: CellModel) -> SampleBlock:
    """Return the samples within the cell's limits of voltage and current.

    Raises:
        UserError: Most samples lie outside the limits, or too few lie within.
    """
    limits = cell.cell
    voltage_v, current_a = samples["voltage_v"], samples["current_a"]
    good = select_samples(
        samples,
        (voltage_v >= limits.voltage_min_v)
        & (voltage_v <= limits.voltage_max_v)
        & (np.abs(current_a) <= limits.current_max_a),
    )
    if good.size < MIN_GOOD_FRACTION * samples.size:
        raise UserError(
            f"{name}: {good.size} of {samples.size} samples lie within the cell's limits ({limits.voltage_min_v:g} to "
            f"{limits.voltage_max_v:g} V, {limits.current_max_a:g} A); the capture runs from {voltage_v.min():.3f} to "
            f"{voltage_v.max():.3f} V and {current_a.min():.3f} to {current_a.max():.3f} A: check the cell file and "
            "the number of cells in series (option --series of calibrate, report and validate)"
        )
    if good.size < WINDOW_SAMPLES:
        raise UserError(f"{name}: {good.size} good samples are too few, at least {WINDOW_SAMPLES} are needed")
    return good


def _without_spikes(samples: SampleBlock, cell: CellModel) -> SampleBlock:
    """Remove voltage spikes that the current does not explain, and current spikes without a change of voltage."""
    a13, a14, a15 = cell.a[13:16]  # coefficients of R_s(SOC) = a13 e^(-a14 SOC) + a15
    max_ohm = RESISTANCE_FACTOR * (a13 * np.exp(-0.5 * a14) + a15)
    deviation_v = np.abs(_deviation_from_median(samples["voltage_v"]))
    deviation_a = np.abs(_deviation_from_median(samples["current_a"]))
    voltage_spike = deviation_v > SPIKE_V * cell.cell.series_count + max_ohm * deviation_a
    current_spike = (deviation_a > SPIKE_C * cell.cell.capacity_ah) & (
        deviation_v < UNCHANGED_FRACTION * max_ohm * deviation_a
    )
    return select_samples(samples, ~(voltage_spike | current_spike))


def _deviation_from_median(values: Floats) -> Floats:
    """Return each value less the median of the value and its neighbors; 0 at the ends."""
    windows = np.lib.stride_tricks.sliding_window_view(values, WINDOW_SAMPLES)
    deviation = np.zeros(values.size)
    for begin in range(0, len(windows), BLOCK_SAMPLES):
        medians = np.median(windows[begin : begin + BLOCK_SAMPLES], axis=1)
        middle = slice(begin + NEIGHBORS, begin + NEIGHBORS + medians.size)
        deviation[middle] = values[middle] - medians
    return deviation
