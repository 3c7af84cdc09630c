"""Settings record of the filter from cell file and settings."""

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.cell_model.current_interpolation import PERIODS, UNMEASURED_S
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, RESISTANCES, TAU_S, weak_share
from bms_estimator.kernels.kalman_filter.records import EKF_SETTINGS, Noise
from bms_estimator.model.cell import CellModel, TableOcv
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.settings.sampling import BOARD, Sampling

CURVE_ERROR_V, CURVE_ERROR_SOC = 0.004, 0.007
"""Std of one cell's OCV [V] and std along SOC, for a cell file that does not declare its error."""
STEEPEST_V = 5.0
"""Slope near full and empty above which the end of a cell's OCV is known better than its SOC elsewhere [V]."""
LEARNED, LEARNED_SLOPE_V = 0.97, 0.15
"""Fraction of the OCV's error variance that is learned permanently, where its slope is at least this everywhere [V].
On a plateau a voltage does not distinguish the error of the curve from the SOC, and the knees move."""
CURVE_SOC, KNEE_V, TURN = 0.3, 1.0, 4.0
"""Correlation length of the OCV's error [SOC], also over a change between flat and steep: on a plateau the error is
in volts, at a knee, of slopes above ``KNEE_V`` per cell [V], in SOC. The correlation of both is e^-(TURN x angle
in radians)."""
COUNT_ERROR_SOC = 0.004
"""However well the curve is known: how full the cell was that it was measured on, std."""
BEYOND_BRANCHES = 0.2
"""Two branches leave out diffusion that is slower: its resistance, as a part of theirs."""
BRANCHES_STD = 0.35
"""Relative std of resistances derived from two RC pairs."""
BIAS_OF_STD = 0.15
"""Fraction of the resistances' relative std that becomes ``bias_relative``, because uncertain resistances are wrong
in their ratios, too."""
ROOM_C = 15.0, 35.0
"""Resistances of unknown temperature are those of a room [C]."""
MIN_SHARE = 1e-4
"""No branch has less than this part of the sum at SOC 0.5: time constants are means weighted by resistance."""
MIN_CAPACITANCE = 0.05
"""C_ts, C_tl, negative below delta1, delta2, are at least this part of a9, a12."""

SOC_GRID = np.linspace(0.0, 1.0, GRID)
"""SOC grid of the resistances and of the OCV's error. Shape (GRID,)."""


def filter_settings(
    cell: CellModel,
    grid: tuple[NDArray[np.float64], NDArray[np.float64]],
    identifier: IdentifierSettings,
    voltage_resolution_v: float,
    voltage_noise_v: float | None,
    sampling: Sampling = BOARD,
) -> NDArray[np.void]:
    """Return the filter's settings record.

    Args:
        cell: The pack as one object.
        grid: Open-circuit voltage and its slope, from ``records.ocv_grid`` [V].
        identifier: Section ``[identifier]``.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
        voltage_noise_v: Standard deviation of a sample there [V]; None: half a step.
        sampling: Resolution and period of the source.

    Returns:
        Shape (1,), dtype ``EKF_SETTINGS``.
    """
    record = np.zeros(1, dtype=EKF_SETTINGS)
    p, series = record[0], cell.cell.series_count
    p["capacity_as"], p["series"] = 3600.0 * cell.cell.capacity_ah, series
    p["ocv_v"], p["ocv_slope_v"] = grid
    _open_circuit(p, cell, identifier.hysteresis_v)
    weak_ohm, strong_ohm, r_std, (p["low_c"], p["high_c"]) = _ladder(cell)
    middle = GRID // 2
    p["middle_ohm"] = weak_ohm[middle].sum() + strong_ohm[middle].sum()
    p["weak_ohm"], p["strong_ohm"] = np.maximum(weak_ohm, MIN_SHARE * p["middle_ohm"]), strong_ohm
    noise_v = 0.5 * voltage_resolution_v if voltage_noise_v is None else voltage_noise_v
    p["sensor_v2"] = noise_v**2 + voltage_resolution_v**2 / 12.0
    p["unmeasured_s"] = unmeasured_s(sampling)
    p["current_step_a"], p["dead_band_a"] = sampling.current_resolution_a, sampling.current_dead_band_a
    noise = Noise(r_std=r_std)
    if identifier.current_offset_std_a is not None:
        noise = replace(noise, offset_c=identifier.current_offset_std_a / cell.cell.capacity_ah)
    capacity_std = cell.cell.capacity_std if identifier.capacity_std is None else identifier.capacity_std
    for name, told in (("capacity_std", capacity_std), ("soc_std", identifier.soc_std)):
        if told is not None:
            noise = replace(noise, **{name: told})
    noise = replace(noise, bias_relative=max(noise.bias_relative, BIAS_OF_STD * r_std))
    for field in fields(noise):
        p[field.name] = getattr(noise, field.name)
    p["model_v"] *= series
    return record


def unmeasured_s(sampling: Sampling) -> float:
    """Return the longest step over which the current counts as measured [s]."""
    return max(UNMEASURED_S, PERIODS * sampling.period_s)


def _open_circuit(p: np.void, cell: CellModel, hysteresis_v: float | None) -> None:
    """Fill in the error of E_o at 25 C, hysteresis and the temperature coefficient.

    Args:
        p: Record of dtype EKF_SETTINGS, with E_o; written.
        cell: The pack as one object.
        hysteresis_v: OCV after charge less that after discharge, of one cell [V]; None: the cell file's.
    """
    series, ocv = p["series"], cell.ocv
    slope_v = np.interp(SOC_GRID, np.linspace(0.0, 1.0, p["ocv_slope_v"].size), p["ocv_slope_v"])
    radians = np.abs(np.gradient(np.arctan(slope_v / (KNEE_V * series)), SOC_GRID))
    p["curve_soc"] = 1.0 / (1.0 / CURVE_SOC + TURN * radians)
    slope_v = np.minimum(slope_v, STEEPEST_V * series)
    p["curve_error_v"] = np.hypot(CURVE_ERROR_V * series, CURVE_ERROR_SOC * slope_v)
    midway = False
    if isinstance(ocv, TableOcv):
        midway = ocv.hysteresis_v is not None
        for name in ("error_v", "hysteresis_v", "per_kelvin_v"):
            column = getattr(ocv, name)
            if column is not None:
                p["curve_error_v" if name == "error_v" else name] = np.interp(SOC_GRID, ocv.soc, column)
        if ocv.error_v is not None:
            p["curve_error_v"] = np.hypot(p["curve_error_v"], COUNT_ERROR_SOC * slope_v)
    p["learned"] = LEARNED if slope_v.min() >= LEARNED_SLOPE_V * series else 0.0
    if hysteresis_v is not None:
        p["hysteresis_v"] = 0.5 * hysteresis_v * series
        if not midway:  # the curve is that after discharge
            p["ocv_v"] += 0.5 * hysteresis_v * series


def _ladder(cell: CellModel) -> tuple[NDArray[np.float64], NDArray[np.float64], float, tuple[float, float]]:
    """Weak and strong part of the resistances, each (GRID, RESISTANCES) [ohm], their relative std, temperatures [C]."""
    ladder = cell.ladder
    if ladder is None:
        ohm, weak = ladder_of_branches(cell), weak_share(SOC_GRID).T
        return weak * ohm, (1.0 - weak) * ohm, BRANCHES_STD, ROOM_C
    weak_ohm, strong_ohm = (
        np.column_stack([np.interp(SOC_GRID, ladder.soc, row) for row in rows])
        for rows in (ladder.weak_ohm, ladder.strong_ohm)
    )
    return weak_ohm, strong_ohm, ladder.std, ladder.temperature_c


def ladder_of_branches(cell: CellModel) -> NDArray[np.float64]:
    """Return the network's resistances [ohm] that are equivalent to (2.5)-(2.9). Shape (GRID, RESISTANCES).

    Each branch is shared between the two time constants of the ladder around its own, by the logarithm.
    """
    ohm, a = np.zeros((GRID, RESISTANCES)), cell.a
    ln_taus = np.log(TAU_S)
    for i, soc in enumerate(SOC_GRID):
        ohm[i, 0] = chen_mora.r_s(soc, a)
        c_ts = max(chen_mora.c_ts(soc, a), MIN_CAPACITANCE * a[9])
        c_tl = max(chen_mora.c_tl(soc, a), MIN_CAPACITANCE * a[12])
        for r, c in ((chen_mora.r_ts(soc, a), c_ts), (chen_mora.r_tl(soc, a), c_tl)):
            position = float(np.interp(np.log(r * c), ln_taus, np.arange(BRANCHES)))
            k = min(int(position), BRANCHES - 2)
            ohm[i, 1 + k] += r * (k + 1 - position)
            ohm[i, 2 + k] += r * (position - k)
            ohm[i, BRANCHES] += BEYOND_BRANCHES * r
    return ohm
