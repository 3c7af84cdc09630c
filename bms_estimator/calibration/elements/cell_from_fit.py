"""Cell and RC ladder: the prior of a fit from a cell, and the cell of a fit with two equivalent RC pairs at 25 C.

Each element of the equivalent RC pairs is an exponential of SOC plus an offset, (2.5)-(2.9) of the thesis. delta1 (2.11) and delta2 (2.12) are the
SOCs below which the capacitances are negative.
"""

import numpy as np
from scipy.optimize import nnls

from bms_estimator.calibration.elements.ladder_fit import (
    EVEN_SOC,
    FIXED_OCV_STD_V,
    FIXED_PER_KELVIN_STD_V,
    MEASURED_PER_KELVIN_STD_V,
    PER_KELVIN_STD_V,
    ZERO_FRACTION,
    LadderFit,
    Prior,
    Run,
    spans_temperature,
    temperature_range,
)
from bms_estimator.calibration.elements.normal_equations import KELVIN_NODES, SOC_NODES, correction_at
from bms_estimator.calibration.elements.replay_score import MAX_STEP_S
from bms_estimator.calibration.ocv.hysteresis import RESTED_FRACTION_STD, has_plateau
from bms_estimator.calibration.ocv.overpotential import arrhenius, linear_interpolation_matrix, overpotential
from bms_estimator.calibration.ocv.slow_curve import PAIR_V
from bms_estimator.estimator.filter_settings import CURVE_ERROR_SOC, CURVE_ERROR_V
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import HIGH_ACTIVATION_ENERGY, RESISTANCES, weak_share
from bms_estimator.kernels.kalman_filter.equivalent_circuit import LN_TAUS, SHORT_PAIRS
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import Capacitance, Ladder, Resistance, TableOcv

GENERIC_STD = 0.3
"""Minimum relative std of a generic ladder. A ladder with a smaller std was identified, so that its temperature range
comes from captures."""
SHAPE_MIN_SOC = 0.4
"""SOC above which a resistance is averaged to normalize its shape."""
SHAPE_LIMITS = (0.2, 20.0)
"""Limits of a resistance relative to its mean above ``SHAPE_MIN_SOC``."""


def ladder_prior(cell: CellModel, scale_ohm: float, *, refine_ocv: bool, spans_temperature: bool) -> Prior:
    """Return the prior of the fit to captures of a cell.

    Args:
        cell: Given cell.
        scale_ohm: Scale of the resistances [ohm].
        refine_ocv: Correct the OCV as well.
        spans_temperature: True if the captures give activation energies and dE/dT.
    """
    series, given = cell.cell.series_count, cell.ladder
    measured = isinstance(cell.ocv, TableOcv) and cell.ocv.per_kelvin_v is not None
    per_kelvin_std_v = MEASURED_PER_KELVIN_STD_V if measured else PER_KELVIN_STD_V
    return Prior(
        ocv_error_v=_curve_error(cell) if refine_ocv else np.full(EVEN_SOC.size, FIXED_OCV_STD_V),
        per_kelvin_std_v=(per_kelvin_std_v if spans_temperature and refine_ocv else FIXED_PER_KELVIN_STD_V) * series,
        scale_ohm=scale_ohm,
        series=series,
        shapes=_shapes(cell, scale_ohm),
        weak_share=None if spans_temperature else weak_share(SOC_NODES) if given is None else _weak_share_of(given),
    )


def ocv_error(cell: CellModel) -> Floats:
    """Return the std of the given OCV at ``EVEN_SOC`` [V]."""
    if isinstance(cell.ocv, TableOcv) and cell.ocv.error_v is not None:
        return np.interp(EVEN_SOC, cell.ocv.soc, cell.ocv.error_v)
    slope_v = np.interp(EVEN_SOC, np.linspace(0.0, 1.0, ocv_grid(cell)[1].size), ocv_grid(cell)[1])
    return np.hypot(CURVE_ERROR_V * cell.cell.series_count, CURVE_ERROR_SOC * slope_v)


def _shapes(cell: CellModel, scale_ohm: float) -> Floats:
    """Return the prior shape of the weak and strong part of each resistance over SOC, at ``SOC_NODES``.

    The shape of an identified ladder is used unchanged. For a generic ladder, the square root of the shape is used,
    because cells differ. The shape is constant for a cell with a voltage plateau, because the generic shape did not
    fit the captures of an LFP cell.
    """
    given, grid_v = cell.ladder, ocv_grid(cell)[0]
    if given is None or has_plateau(np.linspace(0.0, 1.0, grid_v.size), grid_v, cell.cell.series_count):
        return np.ones((2, RESISTANCES, SOC_NODES.size))
    rows = _at_nodes(given)
    mean_ohm = rows[:, :, SOC_NODES > SHAPE_MIN_SOC].mean(axis=2, keepdims=True)
    is_zero = mean_ohm < ZERO_FRACTION * scale_ohm  # a resistance of 0 has no shape
    shapes = np.clip(np.where(is_zero, 1.0, rows / np.where(is_zero, 1.0, mean_ohm)), *SHAPE_LIMITS)
    return np.asarray(np.sqrt(shapes) if given.std >= GENERIC_STD else shapes)


def _at_nodes(ladder: Ladder) -> Floats:
    """Return the weak and strong part at ``SOC_NODES``, shape (2, RESISTANCES, SOC_NODES.size) [ohm]."""
    parts = ladder.weak_ohm, ladder.strong_ohm
    return np.array([[np.interp(SOC_NODES, ladder.soc, ohm) for ohm in part] for part in parts])


def _weak_share_of(ladder: Ladder) -> Floats:
    """Return the fraction of each resistance with the weak temperature dependence, at ``SOC_NODES``."""
    weak, strong = _at_nodes(ladder)
    return np.where(weak + strong > 0.0, weak / np.maximum(weak + strong, 1e-12), weak_share(SOC_NODES))


def _curve_error(cell: CellModel) -> Floats:
    """Return the std of the OCV curve at ``EVEN_SOC`` [V], without the error of the hysteresis.

    Captures of drives are discharges. With the error of the hysteresis in the prior, the fit would correct the curve by
    that error, and the correction would have the wrong sign in charges.
    """
    error_v = ocv_error(cell)
    if not isinstance(cell.ocv, TableOcv) or cell.ocv.hysteresis_v is None:
        return error_v
    hysteresis_v = RESTED_FRACTION_STD * np.interp(EVEN_SOC, cell.ocv.soc, cell.ocv.hysteresis_v)
    square_v2: Floats = np.maximum(error_v**2 - hysteresis_v**2, (PAIR_V * cell.cell.series_count) ** 2)
    return np.sqrt(square_v2)


SOC = np.linspace(0.02, 1.0, 50)
"""SOC grid on which the curves are fitted to the resistances of the ladder."""
EXPONENTS = np.geomspace(1.0, 60.0, 60)
"""Candidate exponents b of A e^(-b SOC) + c."""
NEGLIGIBLE = 1e-4
"""Relative amplitude that replaces a fitted amplitude of 0. A cell file requires an amplitude above 0."""
MIN_FRACTION = 1e-4
"""Minimum resistance of a section, as a fraction of the sum. A cell file requires values above 0."""
MAX_DELTA = 0.01
"""Maximum delta1 and delta2. The capacitances are positive down to this SOC."""
SECTIONS = {"r_s": (0, 1), "r_ts": (1, 1 + SHORT_PAIRS), "r_tl": (1 + SHORT_PAIRS, RESISTANCES)}
"""First index, and index after the last, of the ladder's resistances whose sum each section of the cell file
contains."""


def cell_file_sections(ladder: Ladder) -> dict[str, Resistance | Capacitance]:
    """Return the five sections of a cell file that contain a1..a15."""
    total_ohm = (
        linear_interpolation_matrix(SOC, np.array(ladder.soc))
        @ (np.array(ladder.weak_ohm) + np.array(ladder.strong_ohm)).T
    )
    sections: dict[str, Resistance | Capacitance] = {}
    for name, (first_index, end_index) in SECTIONS.items():
        ohm = np.maximum(total_ohm[:, first_index:end_index].sum(axis=1), MIN_FRACTION * total_ohm.sum(axis=1))
        amplitude, exponent, offset = _exponential(ohm, 1.0)
        sections[name] = Resistance(amplitude_ohm=amplitude, exponent=exponent, offset_ohm=offset)
        if (
            name != "r_s"
        ):  # ln tau of the RC pair is the mean of ln tau of its ladder's RC pairs, weighted by resistance
            # the lower limit gives equal weights where all resistances are 0
            fraction = np.maximum(total_ohm[:, first_index:end_index], 1e-6 * total_ohm.sum(axis=1, keepdims=True))
            fraction /= fraction.sum(axis=1, keepdims=True)
            farad = np.exp(fraction @ LN_TAUS[first_index - 1 : end_index - 1]) / ohm
            amplitude, exponent, offset = _exponential(farad, -1.0)
            sections["c" + name[1:]] = Capacitance(amplitude_farad=amplitude, exponent=exponent, offset_farad=offset)
    return sections


def _exponential(values: Floats, sign: float) -> tuple[float, float, float]:
    """Fit ``sign`` A e^(-b SOC) + c to ``values`` by relative least squares; return A, b and c, all positive."""
    # residual, A, b and c; a constant if no exponent fits
    best = (np.inf, NEGLIGIBLE * float(np.median(values)), 10.0, float(np.median(values)))
    for exponent in EXPONENTS:
        curve = np.column_stack([sign * np.exp(-exponent * SOC), np.ones(SOC.size)]) / values[:, None]
        (amplitude, offset), residual = nnls(curve, np.ones(SOC.size))
        positive = sign > 0.0 or amplitude * np.exp(-exponent * MAX_DELTA) < offset
        if residual < best[0] and offset > 0.0 and positive:
            best = (float(residual), max(float(amplitude), NEGLIGIBLE * float(offset)), float(exponent), float(offset))
    return best[1:]


OCV_STEP = 0.01
"""SOC step between the nodes of the corrected OCV table."""
MIN_SLOPE_V = 1e-3
"""Minimum slope dOCV/dSOC of the corrected table per cell [V]."""
LADDER_STD = 0.1
"""Relative std of resistances between cells of one make: two NCR18650 differ by 5 to 8 %, and cells age."""
MIN_RMS_SOC = 0.1
"""Lower SOC limit of the reported RMS errors and of the RMS change of the OCV."""
MIN_ERROR_V = 1e-5
"""Minimum model error written to a cell file [V]. A cell file requires a value above 0."""


def cell_from_fit(
    given: CellModel, fit: LadderFit, runs: list[Run], scale_ohm: float, *, refine_ocv: bool
) -> CellModel:
    """Return the given cell with the fitted values.

    Args:
        given: Cell whose values were the prior.
        fit: Fit to the captures.
        runs: The captures.
        scale_ohm: Order of magnitude of the resistances [ohm]. It keeps the relative std finite if they are near 0.
        refine_ocv: Correct the OCV as well.
    """
    low_c, high_c = temperature_range(runs)
    covers_temperature = spans_temperature(low_c, high_c)
    given_ladder = given.ladder
    # the fit has kept the activation energies of an identified ladder, which also hold in the temperature range of its captures
    if not covers_temperature and given_ladder is not None and given_ladder.std < GENERIC_STD:
        low_c, high_c = min(low_c, given_ladder.temperature_c[0]), max(high_c, given_ladder.temperature_c[1])
    ohm, ohm_std = fit.resistance_sum(0.5, 0, RESISTANCES)
    ladder = Ladder(
        soc=_tuple(SOC_NODES),
        # parts with the low and the high activation energy
        weak_ohm=tuple(map(_tuple, fit.weak_ohm)),
        strong_ohm=tuple(map(_tuple, fit.strong_ohm)),
        std=round(float(np.hypot(LADDER_STD, ohm_std / max(ohm, 1e-9 * scale_ohm))), 3),
        error_v=1.0,  # replaced below
        temperature_c=(low_c, high_c),
    )
    # the given bounds belong to the given elements; without bounds, the defaults follow from the new ones
    update: dict[str, object] = {"ladder": ladder, "adaptation": {}, **cell_file_sections(ladder)}
    if refine_ocv:
        update["ocv"] = _corrected_ocv(given, fit, with_entropy=covers_temperature)
    new = given.model_copy(update=update)
    error_v = max(float(np.sqrt(np.mean([voltage_rms_v(new, run) ** 2 for run in runs]))), MIN_ERROR_V)
    return new.model_copy(update={"ladder": ladder.model_copy(update={"error_v": error_v})})


def voltage_rms_v(cell: CellModel, run: Run) -> float:
    """Return the RMS error of the cell's voltage on a capture, weighted by time and scaled to 25 C [V]."""
    grid_v = ocv_grid(cell)[0]
    ocv_v = np.interp(run.soc, np.linspace(0.0, 1.0, grid_v.size), grid_v)
    error_v = run.capture.voltage_v - ocv_v + overpotential(cell, run.capture_with_temperature, run.soc)
    weight = np.clip(np.diff(run.capture.time_s, append=run.capture.time_s[-1]), 0.0, MAX_STEP_S)
    # the errors of the model grow in the cold with about this activation energy (``normal_equations.ERROR_J``)
    weight *= ((run.soc > MIN_RMS_SOC) & ~run.capture.mismatched) / arrhenius(
        0.5 * HIGH_ACTIVATION_ENERGY, run.temperature_c
    ) ** 2
    return float(np.sqrt((weight * error_v**2).sum() / max(weight.sum(), 1e-12)))


def _corrected_ocv(cell: CellModel, fit: LadderFit, *, with_entropy: bool) -> TableOcv:
    """Return the corrected OCV as an increasing table with the hysteresis and error columns of the cell.

    Args:
        cell: Given cell.
        fit: Fit to the captures.
        with_entropy: Also correct dE/dT.
    """
    given = cell.ocv if isinstance(cell.ocv, TableOcv) else None
    soc = np.linspace(0.0, 1.0, round(1.0 / OCV_STEP) + 1)
    grid_v = ocv_grid(cell)[0]
    min_rise_v = MIN_SLOPE_V * cell.cell.series_count * soc
    corrected_v = np.interp(soc, np.linspace(0.0, 1.0, grid_v.size), grid_v) + correction_at(soc) @ fit.correction
    per_kelvin_v = linear_interpolation_matrix(soc, KELVIN_NODES) @ fit.per_kelvin_v if with_entropy else None
    if given is not None and given.per_kelvin_v is not None:
        given_per_kelvin_v = np.interp(soc, given.soc, given.per_kelvin_v)
        per_kelvin_v = given_per_kelvin_v if per_kelvin_v is None else per_kelvin_v + given_per_kelvin_v
    hysteresis_v = None if given is None or given.hysteresis_v is None else given.hysteresis_v
    return TableOcv(
        form="table",
        soc=_tuple(soc),
        ocv_v=_tuple(np.maximum.accumulate(corrected_v - min_rise_v) + min_rise_v),
        error_v=_tuple(np.interp(soc, EVEN_SOC, ocv_error(cell))),
        hysteresis_v=None if hysteresis_v is None or given is None else _tuple(np.interp(soc, given.soc, hysteresis_v)),
        per_kelvin_v=None if per_kelvin_v is None else _tuple(per_kelvin_v),
    )


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
