"""Discharge of the projected pack to the cut-off under a load with a given mean, variance and peak.

The mean current discharges the pack and polarizes the RC pairs. The voltage reaches the cut-off at a peak. A peak lasts about a
second, so that it adds a drop over R_0 and over a part of R_1 (``PEAK_FRACTION``). The variance of the current causes losses in
these resistances beyond those of the mean current.

``m`` is a record of PROJECTED_PACK, ``d`` of DRAW, ``s`` of EKF_STATE, ``p`` of EKF_SETTINGS. Currents are positive on discharge.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, TAUS
from bms_estimator.kernels.forecast.draws import loaded_voltage
from bms_estimator.kernels.forecast.observed_load import PEAK_FRACTION
from bms_estimator.kernels.forecast.projected_pack import grid_position, project_pack
from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit

MIN_LOAD_C = 0.05
"""Minimum mean current of the load, as a C-rate. It is used at rest and while charging."""
SOC_STEP = 0.005
"""Step of the SOC towards empty. The crossing of the cut-off voltage is interpolated within a step."""


@njit(cache=True)
def charge_to_cutoff(
    state: Records, settings: Records, cutoff_v: float, largest_a: float, pack: Records, draw: Records
) -> tuple[float, float]:
    """Return the charge [A s] and the energy at the terminals [W s] until the cut-off.

    A caller in Python passes an array ten times faster than a record.

    Args:
        state: Shape (1,), dtype EKF_STATE.
        settings: Shape (1,), dtype EKF_SETTINGS.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        largest_a: Largest current of the load [A].
        pack: Shape (1,), dtype PROJECTED_PACK; written.
        draw: Shape (1,), dtype DRAW; written.
    """
    project_pack(pack[0], state[0], settings[0], cutoff_v, largest_a)
    return discharge_to_cutoff(pack[0], state[0], settings[0], largest_a, draw[0])


@njit(cache=True)
def discharge_to_cutoff(m: Record, s: Record, p: Record, largest_a: float, d: Record) -> tuple[float, float]:
    """Return the charge [A s] and the energy at the terminals [W s] until the cut-off.

    The load has mean and variance of the last ten minutes, and a mean of at least ``MIN_LOAD_C``.

    Args:
        m: Record of PROJECTED_PACK.
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        largest_a: Largest current of the load [A].
        d: Record of DRAW; the pack without random errors is written to it.
    """
    draw_without_errors(d, m)
    mean_a = max(s.mean_a - m.offset_a, MIN_LOAD_C * p.capacity_as / 3600.0)
    peak_a, variance_a2 = max(largest_a - m.offset_a, mean_a), max(s.rms_a2 - s.mean_a * s.mean_a, 0.0)
    soc, charge_as, energy_ws = d.begin_soc, 0.0, 0.0
    mean_v, peak_v = mean_and_peak_voltage(m, d, mean_a, peak_a, variance_a2, soc)
    while soc > 0.0 and peak_v > m.cutoff_v:
        step = min(SOC_STEP, soc)
        next_mean_v, next_peak_v = mean_and_peak_voltage(m, d, mean_a, peak_a, variance_a2, soc - step)
        fraction = 1.0 if next_peak_v > m.cutoff_v else (peak_v - m.cutoff_v) / (peak_v - next_peak_v)
        step_as = fraction * step * d.capacity_as
        charge_as += step_as
        energy_ws += step_as * (mean_v + 0.5 * fraction * (next_mean_v - mean_v))
        soc, mean_v, peak_v = soc - step, next_mean_v, next_peak_v
    return charge_as, energy_ws


@njit(cache=True)
def draw_without_errors(d: Record, m: Record) -> None:
    """Write the pack without random errors to the draw ``d``. Its weakest cell equals the mean of the cells."""
    d.begin_soc, d.capacity_as, d.load_factor = m.soc - m.surface_soc, m.capacity_as, 1.0
    d.voltage_error_v, d.resistance_factor = 0.0, m.resistance_mean


@njit(cache=True)
def mean_and_peak_voltage(
    m: Record, d: Record, mean_a: float, peak_a: float, variance_a2: float, soc: float
) -> tuple[float, float]:
    """Return the energy per charge and the voltage at a peak [V], after a discharge to ``soc`` with the mean current.

    Args:
        m: Record of PROJECTED_PACK.
        d: Record of DRAW.
        mean_a: Mean current [A], above 0.
        peak_a: Peak current [A], at least ``mean_a``.
        variance_a2: Variance of the current [A^2].
        soc: SOC at which the voltages are computed.
    """
    elapsed_s = (d.begin_soc - soc) * d.capacity_as / mean_a
    i, t = grid_position(soc)
    fast_ohm = m.ohm[0, i] + t * (m.ohm[0, i + 1] - m.ohm[0, i])
    drop_v = fast_ohm * mean_a
    for k in range(BRANCHES):
        r_ohm = m.ohm[1 + k, i] + t * (m.ohm[1 + k, i + 1] - m.ohm[1 + k, i])
        drop_v += r_ohm * (mean_a + (m.x_a[k] - mean_a) * math.exp(-elapsed_s / TAUS[k]))
        if k == 0:
            fast_ohm += PEAK_FRACTION * r_ohm
    return (
        loaded_voltage(d, m, soc, drop_v + fast_ohm * variance_a2 / mean_a),
        loaded_voltage(d, m, soc, drop_v + fast_ohm * (peak_a - mean_a)),
    )
