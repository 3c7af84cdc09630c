"""A capture without glitches, prepared for calibration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.cleaning.mismatched_steps import are_mismatched, with_matched_voltages
from bms_estimator.calibration.cleaning.rests import REST_C_RATE, remove_glitches, select_samples
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.charge_count import charge_ah
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

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
    mismatched: NDArray[np.bool_]
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
