"""Creation of a cell from a fit: the fitted ladder, the elements of two RC pairs, and the corrected OCV."""

import numpy as np

from bms_estimator.calibration.elements import two_branch_fit
from bms_estimator.calibration.elements.capture_run import Run, spans_temperature, temperature_range
from bms_estimator.calibration.elements.ladder_columns import KELVIN_NODES, SOC_NODES, correction_at
from bms_estimator.calibration.elements.ladder_fit import EVEN_SOC, LadderFit
from bms_estimator.calibration.elements.ladder_prior import GENERIC_STD, ocv_error
from bms_estimator.calibration.elements.replay_score import MAX_STEP_S
from bms_estimator.calibration.ocv.overpotential import arrhenius, linear_interpolation_matrix, overpotential
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import HIGH_ACTIVATION_ENERGY, RESISTANCES
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv

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
    update: dict[str, object] = {"ladder": ladder, "adaptation": {}, **two_branch_fit.cell_file_sections(ladder)}
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
