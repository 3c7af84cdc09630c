"""Step 3 of the thesis, sample by sample: R_s by (4.2) of the thesis, least squares in each bin of 1 % SOC.

x2 and x3 of (4.2) are those of the model with the present a1..a12 under the measured current. The observer's own x2 and x3
absorb every error of the voltage, including i R_s.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, ocv, r_tl, r_ts, rc_step
from bms_estimator.kernels.observer.observer import stability_floor
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

BINS = 100
"""Number of SOC bins, one value of R_s each."""
MIN_CURRENT_C = 0.02
"""Minimum current for (4.2) as C-rate [1/h]. Below, the sensor's noise dominates."""
MAX_SAMPLES = 20_000
"""Number of samples of a bin at which its sums are halved, so that R_s follows the aging of the cell."""

SERIES_RESISTANCE = np.dtype(
    [
        ("v_ts", "f8"),  # x2 of the model [V]
        ("v_tl", "f8"),  # x3 of the model [V]
        ("settle_s", "f8"),  # remaining time without sums, while x2 and x3 depend on an unmeasured load [s]
        ("samples", "f8", BINS),  # number of samples in the sums
        ("square_a2", "f8", BINS),  # sum of i^2 [A^2]
        ("product_va", "f8", BINS),  # sum of i (E_o - x2 - x3 - y) [V A]
    ],
    align=True,
)
"""Sums of the least squares for R_s."""


@njit(cache=True)
def initialize_series_resistance(s: Record, p: Record) -> None:
    """Reset sums and RC voltages after the observer's first sample.

    At rest the RC voltages are 0. Under load they are unknown, so that the sums start after ``settle_s``. ``s`` is a
    record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.
    """
    r = s.series_resistance
    r.v_ts = r.v_tl = 0.0
    r.settle_s = p.learning.settle_s if current_suffices(s.observer.current_a, p) else 0.0
    r.samples[:] = 0.0
    r.square_a2[:] = 0.0
    r.product_va[:] = 0.0


@njit(cache=True)
def current_suffices(current_a: float, p: Record) -> bool:
    """Return True if a current is large enough for (4.2); ``p`` is a record of ESTIMATOR_SETTINGS."""
    return abs(current_a) > MIN_CURRENT_C * p.observer.capacity_as / 3600.0


@njit(cache=True)
def series_resistance_step(
    s: Record, p: Record, dt_s: float, previous_a: float, previous_soc: float, voltage_v: float
) -> None:
    """Advance x2 and x3, and add a sample to the sums of its bin.

    Args:
        s: Record of ESTIMATOR_STATE, after the observer's step.
        p: Record of ESTIMATOR_SETTINGS.
        dt_s: Time since the previous sample [s].
        previous_a: Current at the previous sample, constant until this sample [A].
        previous_soc: SOC at the previous sample.
        voltage_v: Measured voltage [V]; NaN if it was not measured at this sample.
    """
    r, o = s.series_resistance, s.observer
    mid_soc = max(0.5 * (previous_soc + o.soc), stability_floor(o, p.observer))
    ohm_ts, ohm_tl = r_ts(mid_soc, o.a), r_tl(mid_soc, o.a)
    r.v_ts = rc_step(r.v_ts, previous_a, ohm_ts, ohm_ts * c_ts(mid_soc, o.a), dt_s)  # (2.2)
    r.v_tl = rc_step(r.v_tl, previous_a, ohm_tl, ohm_tl * c_tl(mid_soc, o.a), dt_s)  # (2.3)
    r.settle_s = max(r.settle_s - dt_s, 0.0) if dt_s <= p.observer.unmeasured_s else p.learning.settle_s
    if r.settle_s > 0.0 or not o.adapting or math.isnan(voltage_v) or not current_suffices(o.current_a, p):
        return
    b = bin_of(o.soc)
    if r.samples[b] >= MAX_SAMPLES:
        r.samples[b] *= 0.5
        r.square_a2[b] *= 0.5
        r.product_va[b] *= 0.5
    r.samples[b] += 1.0
    r.square_a2[b] += o.current_a * o.current_a
    r.product_va[b] += o.current_a * (
        ocv(o.soc, p.observer.ocv_v, p.observer.ocv_slope_v) - r.v_ts - r.v_tl - voltage_v
    )


@njit(cache=True)
def series_resistance(s: Record) -> float:
    """Return R_s by (4.2), with the sign of (2.4), in the bin of the present SOC [ohm]; NaN for a bin without data.

    ``s`` is a record of ESTIMATOR_STATE.
    """
    r, b = s.series_resistance, bin_of(s.observer.soc)
    return r.product_va[b] / r.square_a2[b] if r.square_a2[b] > 0.0 else math.nan


@njit(cache=True)
def bin_of(soc: float) -> int:
    """Return the index of the bin that contains ``soc``, 0..1."""
    return min(max(int(soc * BINS), 0), BINS - 1)
