"""Settings records of the Kalman filter and of the learning law from cell file and settings.

(2.5)-(2.9) are equations of the thesis: the circuit elements as functions of SOC with parameters a1..a15.
"""

import math
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.cell_model.chen_mora import PARAMETERS, delta
from bms_estimator.kernels.cell_model.current_interpolation import MAX_STEP_PERIODS
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, RESISTANCES, TAU_S, weak_share
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION
from bms_estimator.kernels.kalman_filter.records import EKF_SETTINGS, Noise
from bms_estimator.kernels.observer.chen_mora_sensitivity import NAMES
from bms_estimator.kernels.observer.learning_law import Model
from bms_estimator.kernels.observer.records import LEARNING_SETTINGS
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.unmeasured_time import UNMEASURED_S
from bms_estimator.settings.observer import EXACT, IdentifierSettings, ObserverSettings, Sampling

CURVE_ERROR_V = 0.004
"""Default std of the OCV per cell, for a cell file without an error column [V]."""
CURVE_ERROR_SOC = 0.007
"""Default std of the OCV along SOC, for a cell file without an error column."""
MAX_SLOPE_V = 5.0
"""Upper limit of the slope per cell that converts an error of SOC to one of the OCV [V]. The SOC is better defined at the
steep ends of the curve."""
LEARNED_FRACTION = 0.97
"""Fraction of the OCV's error variance that is constant and is learned."""
PLATEAU_SLOPE_V = 0.15
"""Slope dOCV/dSOC per cell below which the OCV has a plateau [V]. There the voltage cannot distinguish an error of the curve from
an error of the SOC, and the knees move. Only an error that is common to all SOCs is then learned."""
MEASURED_STD_V = 2.0 * CURVE_ERROR_V
"""Maximum std of the OCV of a measured cell [V]. A larger std on a plateau is due to a level that differs between makes. The
variance of this level is the smallest variance of the curve, less the square of this constant. The A123 26650 is 11 mV above
``lfp``, with a std of 4 mV along the plateau."""
COMMON_CORRELATION = 0.9999
"""Correlation of the constant errors at two neighboring nodes of an OCV with a plateau. A correlation of 1 has no inverse."""
CURVE_SOC = 0.3
"""Correlation length of the OCV's error in SOC."""
KNEE_V = 1.0
"""Slope dOCV/dSOC per cell that counts as an angle of 45 degrees [V]."""
KNEE_DECORRELATION = 4.0
"""Decrease of ln of the correlation of the OCV's error per radian of slope angle. On a plateau the curve has an error of voltage
and at a knee an error of SOC, and both are nearly independent."""
COUNT_ERROR_SOC = 0.004
"""Minimum std of the OCV curve along SOC, due to the error of the SOC in the measurement of the cell."""
SLOW_DIFFUSION = 0.2
"""Resistance of diffusion slower than both RC pairs, as a fraction of each pair's resistance."""
BRANCHES_STD = 0.35
"""Relative std of resistances derived from two RC pairs."""
MIN_BIAS_OF_R_STD = 0.15
"""Minimum of ``bias_relative``, as a fraction of the resistances' relative std. Resistances with a large std also have uncertain
ratios, which the scales LN_R0 and LN_R cannot correct."""
ROOM_C = 15.0, 35.0
"""Lower and upper end of the temperature range of resistances without a declared range, as in a room [C]."""
MIN_SOC_STD = 0.005
"""Minimum std of the published SOC, because full and empty of a cell are not defined more precisely."""
MIN_SOC_STD_OF_R_STD = 0.03
"""Minimum std of the published SOC, as a fraction of the std of ln R. Without measurements of the cell, the point of the OCV
curve at which it is full is uncertain."""
MIN_RESISTANCE = 1e-4
"""Minimum of each resistance, as a fraction of the sum at SOC 0.5. Equivalent time constants are weighted by resistance
and need weights above 0."""
MIN_CAPACITANCE = 0.05
"""Lower limit of C_ts and C_tl, as fractions of their offsets a9 and a12, because their functions are negative near empty."""

SOC_GRID = np.linspace(0.0, 1.0, GRID)
"""SOC grid of the resistances and of the OCV's error. Shape (GRID,)."""


def filter_settings(
    cell: CellModel,
    ocv_and_slope_v: tuple[NDArray[np.float64], NDArray[np.float64]],
    identifier: IdentifierSettings,
    voltage_resolution_v: float,
    voltage_noise_v: float | None,
    sampling: Sampling = EXACT,
) -> NDArray[np.void]:
    """Return the filter's settings record.

    Args:
        cell: The pack as one two-terminal object.
        ocv_and_slope_v: Open-circuit voltage and its slope, from ``settings_records.ocv_grid`` [V].
        identifier: Section ``[identifier]``.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
        voltage_noise_v: Standard deviation of a voltage sample [V]; None: half of ``voltage_resolution_v``.
        sampling: Resolution, period and gain errors of the source.

    Returns:
        Shape (1,), dtype ``EKF_SETTINGS``.
    """
    record = np.zeros(1, dtype=EKF_SETTINGS)
    p, series = record[0], cell.cell.series_count
    p["capacity_as"], p["series"] = 3600.0 * cell.cell.capacity_ah, series
    p["ocv_v"], p["ocv_slope_v"] = ocv_and_slope_v
    _open_circuit(p, cell, identifier.hysteresis_v)
    _add_voltage_gain_error(p, sampling.voltage_gain_std)
    weak_ohm, strong_ohm, r_std, (p["low_c"], p["high_c"]) = _ladder_resistances(cell)
    mid_soc = GRID // 2
    p["middle_ohm"] = weak_ohm[mid_soc].sum() + strong_ohm[mid_soc].sum()
    p["weak_ohm"], p["strong_ohm"] = np.maximum(weak_ohm, MIN_RESISTANCE * p["middle_ohm"]), strong_ohm
    noise_v = 0.5 * voltage_resolution_v if voltage_noise_v is None else voltage_noise_v
    p["sensor_v2"] = noise_v**2 + voltage_resolution_v**2 / 12.0  # noise and rounding
    p["unmeasured_s"] = unmeasured_s(sampling)
    p["current_step_a"], p["dead_band_a"] = sampling.current_resolution_a, sampling.current_dead_band_a
    noise = _noise(cell, identifier, sampling, r_std)
    p["min_soc_std"] = max(MIN_SOC_STD, MIN_SOC_STD_OF_R_STD * noise.r_std)
    for field in fields(noise):
        p[field.name] = getattr(noise, field.name)
    p["model_v"] *= series  # it is configured for one cell
    return record


def _noise(cell: CellModel, identifier: IdentifierSettings, sampling: Sampling, file_r_std: float) -> Noise:
    """Return the uncertainties of cell and source. ``file_r_std`` is the std of ln R in the cell file."""
    r_std = math.sqrt(file_r_std**2 + sampling.current_gain_std**2)
    noise = Noise(r_std=r_std)
    if identifier.current_offset_std_a is not None:
        noise = replace(noise, offset_c=identifier.current_offset_std_a / cell.cell.capacity_ah)
    capacity_std = cell.cell.capacity_std if identifier.capacity_std is None else identifier.capacity_std
    for name, configured in (("capacity_std", capacity_std), ("soc_std", identifier.soc_std)):
        if configured is not None:
            noise = replace(noise, **{name: configured})
    return replace(
        noise,
        # a gain error of the current sensor has the same effect as an error of the capacity
        capacity_std=math.sqrt(noise.capacity_std**2 + sampling.current_gain_std**2),
        bias_relative=max(noise.bias_relative, MIN_BIAS_OF_R_STD * r_std),
    )


def max_ohm(p: np.void) -> float:
    """Return the total resistance at SOC 1 and 25 C plus two std [ohm]. ``p`` is a record of dtype EKF_SETTINGS."""
    return float((1.0 + 2.0 * p["r_std"]) * (p["weak_ohm"][-1] + p["strong_ohm"][-1]).sum())


def unmeasured_s(sampling: Sampling) -> float:
    """Return the longest step over which the current counts as measured [s]."""
    return max(UNMEASURED_S, MAX_STEP_PERIODS * sampling.period_s)


def _open_circuit(p: np.void, cell: CellModel, hysteresis_v: float | None) -> None:
    """Write the error of E_o at 25 C, the hysteresis and the temperature coefficient to ``p``.

    Args:
        p: Record of dtype EKF_SETTINGS that contains E_o; written.
        cell: The pack as one two-terminal object.
        hysteresis_v: OCV after charge less OCV after discharge, per cell [V]; None: the cell file's hysteresis.
    """
    series, ocv = p["series"], cell.ocv
    slope_v = np.interp(SOC_GRID, np.linspace(0.0, 1.0, p["ocv_slope_v"].size), p["ocv_slope_v"])
    radians = np.abs(np.gradient([math.atan(slope / (KNEE_V * series)) for slope in slope_v], SOC_GRID))
    p["curve_soc"] = 1.0 / (1.0 / CURVE_SOC + KNEE_DECORRELATION * radians)
    slope_v = np.minimum(slope_v, MAX_SLOPE_V * series)
    p["curve_error_v"] = np.sqrt((CURVE_ERROR_V * series) ** 2 + (CURVE_ERROR_SOC * slope_v) ** 2)
    is_mean_curve = False
    if isinstance(ocv, TableOcv):
        is_mean_curve = ocv.hysteresis_v is not None
        for name in ("error_v", "hysteresis_v", "per_kelvin_v"):
            column = getattr(ocv, name)
            if column is not None:
                p["curve_error_v" if name == "error_v" else name] = np.interp(SOC_GRID, ocv.soc, column)
        if ocv.error_v is not None:
            p["curve_error_v"] = np.sqrt(p["curve_error_v"] ** 2 + (COUNT_ERROR_SOC * slope_v) ** 2)
    has_plateau = slope_v.min() < PLATEAU_SLOPE_V * series
    if np.median(slope_v) < PLATEAU_SLOPE_V * series:
        p["constant_error_v"] = math.sqrt(max(p["curve_error_v"].min() ** 2 - (MEASURED_STD_V * series) ** 2, 0.0))
    elif not has_plateau:
        p["constant_error_v"] = math.sqrt(LEARNED_FRACTION) * p["curve_error_v"]
    p["node_correlation"] = COMMON_CORRELATION if has_plateau else NODE_CORRELATION
    if hysteresis_v is not None:
        p["hysteresis_v"] = 0.5 * hysteresis_v * series
        if not is_mean_curve:  # a curve without hysteresis was measured after discharge
            p["ocv_v"] += 0.5 * hysteresis_v * series


def _add_voltage_gain_error(p: np.void, gain_std: float) -> None:
    """Add the error of the voltage sensor's gain to the error of the OCV in ``p``, a record of dtype EKF_SETTINGS.

    Both errors are constant and have equal effects. The gain's error of the overpotential is negligible.

    Args:
        p: Record that contains E_o and its error; written.
        gain_std: Relative std of the gain.
    """
    ocv_v = np.interp(SOC_GRID, np.linspace(0.0, 1.0, p["ocv_v"].size), p["ocv_v"])
    p["varying_error_v"] = np.sqrt(p["curve_error_v"] ** 2 - p["constant_error_v"] ** 2)
    p["constant_error_v"] = np.sqrt(p["constant_error_v"] ** 2 + (gain_std * ocv_v) ** 2)
    p["curve_error_v"] = np.sqrt(p["curve_error_v"] ** 2 + (gain_std * ocv_v) ** 2)
    p["voltage_gain_std"] = gain_std


def _ladder_resistances(cell: CellModel) -> tuple[NDArray[np.float64], NDArray[np.float64], float, tuple[float, float]]:
    """Return the resistances of the RC ladder.

    Returns:
        Weak and strong part, each of shape (GRID, RESISTANCES) [ohm], their relative std, and their temperature range [C].
    """
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
    """Return the resistances of an RC ladder equivalent to (2.5)-(2.9) [ohm]. Shape (GRID, RESISTANCES).

    The resistance of each RC pair is divided between the two nearest time constants of the ladder by linear interpolation
    of ln tau.
    """
    ohm, a = np.zeros((GRID, RESISTANCES)), cell.a
    ln_taus = [math.log(tau_s) for tau_s in TAU_S]
    for i, soc in enumerate(SOC_GRID):
        ohm[i, 0] = chen_mora.r_s(soc, a)
        c_ts = max(chen_mora.c_ts(soc, a), MIN_CAPACITANCE * a[9])
        c_tl = max(chen_mora.c_tl(soc, a), MIN_CAPACITANCE * a[12])
        for r, c in ((chen_mora.r_ts(soc, a), c_ts), (chen_mora.r_tl(soc, a), c_tl)):
            position = float(np.interp(math.log(min(max(r * c, TAU_S[0]), TAU_S[-1])), ln_taus, np.arange(BRANCHES)))
            k = min(int(position), BRANCHES - 2)
            ohm[i, 1 + k] += r * (k + 1 - position)
            ohm[i, 2 + k] += r * (position - k)
            ohm[i, BRANCHES] += SLOW_DIFFUSION * r  # the slowest RC pair
    return ohm


MEMORY_S = 3600.0
"""Time constant with which data are discounted under load [s]."""
OFFSET_S = 600.0
"""Time constant with which the injection absorbs an error of the open-circuit voltage [s]."""
SETTLE_S = 1200.0
"""Settling time after an unmeasured gap [s]: at least three time constants of the slow RC pair."""
RATE_HZ = 1.0 / 60.0
"""gamma: rate at which theta approaches the solution of the data, at k = 1 [1/s]."""
LEAK_S = 10.0
"""Weight of the nominal parameters, as a duration of data with errors of ``epsilon_v`` [s]."""
MIN_HALF_RANGE = 1e-3
"""Minimum half distance between the bounds of theta in the weight of the leakage, because it is a divisor."""
REACH = 0.5
"""Trust region for theta. The sensitivities are a linearization; beyond this step the second-order error is no longer
small."""
TAU_TS, TAU_TL = NAMES.index("tau_ts"), NAMES.index("tau_tl")
"""Indices of the time constants in theta."""
SCALED_INDICES = {"r_s": (13, 15), "r_ts": (1, 3), "tau_ts": (7, 9), "r_tl": (4, 6), "tau_tl": (10, 12)}
"""Indices of amplitude and offset, the a_i that scale with each element of theta. A time constant has the bounds of its
capacitance, because its resistance has the value of the cell file."""


def learning_settings(cell: CellModel, observer: ObserverSettings, observer_record: np.void) -> NDArray[np.void]:
    """Return the learning law's settings record.

    Args:
        cell: The pack as one two-terminal object.
        observer: Section ``[observer]``.
        observer_record: Record of dtype ``OBSERVER_SETTINGS``.

    Returns:
        Shape (1,), dtype ``LEARNING_SETTINGS``.
    """
    record = np.zeros(1, dtype=LEARNING_SETTINGS)
    q, a, n = record[0], cell.a, len(NAMES)
    q["enabled"], q["model"], q["count"] = observer.law == "learning", Model.CHEN_MORA, n
    q["file"][1:] = a[1:PARAMETERS]
    for j, name in enumerate(NAMES):
        q["lower"][j], q["upper"][j] = _bounds(cell, SCALED_INDICES[name])
    # tau_ts must stay below the geometric mean of both time constants, and tau_tl above it; 0, the value of the file, is
    # allowed even if the file has them in the reverse order
    ln_to_mean = max(0.5 * math.log(a[6] * a[12] / (a[3] * a[9])), 0.0)
    q["upper"][TAU_TS], q["lower"][TAU_TL] = min(q["upper"][TAU_TS], ln_to_mean), max(q["lower"][TAU_TL], -ln_to_mean)
    q["middle"] = 0.5 * (q["lower"] + q["upper"])
    error_v = float(observer_record["epsilon_v"])
    half_range = 0.5 * (q["upper"] - q["lower"])
    q["leak_v2s"][:n] = LEAK_S * error_v**2 / np.maximum(half_range[:n], MIN_HALF_RANGE) ** 2
    q["memory_s"], q["offset_s"], q["settle_s"] = MEMORY_S, OFFSET_S, SETTLE_S
    q["rate"], q["reach"] = RATE_HZ, REACH
    q["told_v"], q["cells"] = error_v, cell.cell.series_count
    q["soc_floor"] = max(delta(a[8], a[9], a[7]), delta(a[11], a[12], a[10])) + observer.margin_guard
    return record


def _bounds(cell: CellModel, scaled: tuple[int, ...]) -> tuple[float, float]:
    """Return the bounds of an element of theta from those of its ``scaled`` parameters. 0, the file's value, is included."""
    bounds = [(cell.bounds(i), cell.a[i]) for i in scaled]
    lower = max(math.log(b.lower / value) for b, value in bounds)
    upper = min(math.log(b.upper / value) for b, value in bounds)
    return min(lower, 0.0), max(upper, 0.0)
