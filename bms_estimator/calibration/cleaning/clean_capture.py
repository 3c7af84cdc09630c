"""A capture as calibration wants it: what the cell did, without glitches."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.rests import REST_CURRENT_C, remove_glitches
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

NEIGHBOURS = 2
"""Number of neighbors on each side by which a glitch is recognized."""
MIN_SAMPLES = 2 * NEIGHBOURS + 1
"""Minimum number of good samples of a capture."""
SPIKE_V = 0.03
"""A voltage off its neighbours' median by more than this, per cell, and more than the current explains, is a glitch [V]."""
SPIKE_C = 0.1
"""A current off its neighbours' median by more than this C-rate while the voltage does not move is a glitch [1/h]."""
EXPLAINED = 3.0
"""Times its series resistance at mid SOC that a change of current may move the voltage by."""


@dataclass(frozen=True)
class CleanCapture:
    """One capture.

    Attributes:
        name: What to call it.
        time_s: Shape (n,), increasing, from 0 [s].
        current_a: Shape (n,), at the sample, discharge positive [A].
        voltage_v: Shape (n,), measured [V].
        temperature_c: Shape (n,), of the cell [C]; NaN where it was not measured.
        discharged_ah: Shape (n,), charge drawn since the first sample [Ah].
        resting_samples: Number of first samples at rest.
        samples: Number of samples in the capture.
        glitches: Number of dropped glitches.
    """

    name: str
    time_s: Floats
    current_a: Floats
    voltage_v: Floats
    temperature_c: Floats
    discharged_ah: Floats
    resting_samples: int
    samples: int
    glitches: int

    @property
    def start_v(self) -> float:
        """Voltage of the first rest [V]; of the first sample where the capture starts under load."""
        return float(np.median(self.voltage_v[: max(self.resting_samples, 1)]))


def clean_capture(name: str, samples: SampleBlock, cell: CellModel) -> CleanCapture:
    """All good samples of a capture.

    Raises:
        UserError: No, too few or mostly samples that cannot be this cell's.
    """
    good = _without_spikes(_within_limits(name, remove_glitches(samples, name), cell), cell)
    time_s = np.ascontiguousarray(good["time_s"] - good["time_s"][0])
    current_a = np.ascontiguousarray(good["current_a"])
    resting = np.abs(current_a) < REST_CURRENT_C * cell.cell.capacity_ah
    return CleanCapture(
        name=name,
        time_s=time_s,
        current_a=current_a,
        voltage_v=np.ascontiguousarray(good["voltage_v"]),
        temperature_c=np.ascontiguousarray(good["temperature_c"]),
        discharged_ah=np.r_[0.0, np.cumsum(current_a[:-1] * np.diff(time_s))] / 3600.0,
        resting_samples=int(np.argmin(resting)) if not resting.all() else resting.size,
        samples=samples.size,
        glitches=samples.size - good.size,
    )


def _within_limits(name: str, samples: SampleBlock, cell: CellModel) -> SampleBlock:
    limits = cell.cell
    voltage_v, current_a = samples["voltage_v"], samples["current_a"]
    good: SampleBlock = samples[
        (voltage_v >= limits.voltage_min_v)
        & (voltage_v <= limits.voltage_max_v)
        & (np.abs(current_a) <= limits.current_max_a)
    ]
    if good.size < 0.5 * samples.size:
        raise UserError(
            f"{name}: {good.size} of {samples.size} samples lie within the cell's limits ({limits.voltage_min_v:g} to "
            f"{limits.voltage_max_v:g} V, {limits.current_max_a:g} A); the capture runs from {voltage_v.min():.3f} to "
            f"{voltage_v.max():.3f} V and {current_a.min():.3f} to {current_a.max():.3f} A: is it this cell's?"
        )
    if good.size < MIN_SAMPLES:
        raise UserError(f"{name}: {good.size} good samples are too few, at least {MIN_SAMPLES} are needed")
    return good


def _without_spikes(samples: SampleBlock, cell: CellModel) -> SampleBlock:
    """Remove voltage jumps that the current does not explain, and current jumps without a change of voltage."""
    off_v = np.abs(_off_median(samples["voltage_v"]))
    off_a = np.abs(_off_median(samples["current_a"]))
    ohm = EXPLAINED * (cell.a[13] * np.exp(-0.5 * cell.a[14]) + cell.a[15])
    jumped = off_v > SPIKE_V * cell.cell.series_count + ohm * off_a
    unheard = (off_a > SPIKE_C * cell.cell.capacity_ah) & (off_v < 0.01 * ohm * off_a)
    good: SampleBlock = samples[~(jumped | unheard)]
    return good


def _off_median(values: Floats) -> Floats:
    """Each value less the median of itself and its neighbours; 0 at the ends."""
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * NEIGHBOURS + 1)
    off = np.zeros(values.size)
    off[NEIGHBOURS:-NEIGHBOURS] = values[NEIGHBOURS:-NEIGHBOURS] - np.median(windows, axis=1)
    return off
