"""Cell model from captures: open-circuit voltage from rests and low-rate curves, and first resistances from the rests."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import FULL_SOC
from bms_estimator.calibration.cleaning.clean_capture import remove_glitches
from bms_estimator.calibration.elements.initial_elements import (
    curve as generic_curve,
    initial_elements,
    nearest_generic_cell,
    scaled_generic_ladder,
)
from bms_estimator.calibration.ocv.chen_mora_fit import ChenMoraFit, Points, fit_chen_mora
from bms_estimator.calibration.ocv.hysteresis import center_on_typical_hysteresis, has_plateau
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest, initial_rest_v
from bms_estimator.calibration.ocv.source import ExternalCurve, OcvSources, Recording
from bms_estimator.calibration.ocv.sources import find_sources, subtract_rc_overpotential
from bms_estimator.calibration.ocv.table_fit import NODES, TableFit, fit_table
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each, soc_from_ocv
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import Cell, CellModel, generic_cells, load_cell
from bms_estimator.model.cell_sections import ELEMENTS, Ladder
from bms_estimator.model.charge_count import charge_ah
from bms_estimator.model.errors import UserError

TYPICAL_CELL_V = 3.7
"""Voltage of one Li-ion cell at half charge [V], from which the number of cells in series is estimated."""
MIN_CELL_V = 1.5
"""Minimum plausible voltage of one cell at half charge [V]."""
MAX_CELL_V = 4.5
"""Maximum plausible voltage of one cell at half charge [V]."""
MAX_CELLS = 300
"""Maximum plausible number of cells in series."""
MIN_VOLTAGE_RATIO = 0.55
"""Minimum voltage of a valid sample as a fraction of the OCV at SOC 0.5: 2.0 V for a cell of 3.7 V, below usual cut-offs."""
MAX_VOLTAGE_RATIO = 1.06
"""Maximum voltage of a valid sample as a fraction of the OCV at SOC 1: 4.45 V for a cell of 4.2 V, above usual overcharge."""
MIN_EMPTY_RATIO = 0.25
"""Minimum plausible ratio of the OCV at SOC 0 to the OCV at SOC 0.5."""
MEASURED_CAPACITY_STD = 0.03
"""Relative standard deviation of a capacity measured by a slow discharge. It covers the gain of the current sensor,
differences between cells of the type, and ageing over some years."""
MIN_CURRENT_LIMIT_C = 5.0
"""Minimum C-rate of ``current_max_a`` in the written cell file, the limit above which a sample is not valid [1/h]."""
PEAK_CURRENT_MARGIN = 1.5
"""Minimum ratio of ``current_max_a`` in the written cell file to the largest current in the captures."""

MIN_DISCHARGED_SOC = 0.05
"""Minimum SOC that a capture draws if the SOC at its start matters. A charge is counted from its end."""
AMBIGUOUS_SOC = (0.05, 0.9)
"""SOCs of another chemistry at which a voltage does not prove a full cell: 3.5 V is a full LFP cell or a nearly empty NMC cell.
The plateau of the curve distinguishes them."""


class OcvForm(StrEnum):
    """Form of the open-circuit voltage in the cell file."""

    CHEN_MORA = "chen-mora"
    """Function (2.10) of the thesis, after Chen and Mora."""
    TABLE = "table"
    """Smooth table over SOC."""


@dataclass(frozen=True)
class OcvCell:
    """Cell with its open-circuit voltage.

    Attributes:
        cell: The cell.
        fit: Fit of the open-circuit voltage.
        sources: Sources of the points, and the capacity.
        generic: Most similar generic cell. Its resistances, scaled to the rests, are the resistances of ``cell``.
    """

    cell: CellModel
    fit: ChenMoraFit | TableFit
    sources: OcvSources
    generic: CellModel


def determine_ocv(
    recordings: Sequence[Recording],
    curves: Sequence[ExternalCurve],
    *,
    name: str,
    form: OcvForm = OcvForm.TABLE,
    capacity_ah: float | None = None,
    initial_soc: float | None = None,
    series_count: int | None = None,
) -> OcvCell:
    """Determine the open-circuit voltage and initial values of the resistances.

    Args:
        recordings: Captures with rests, or of slow discharges and charges.
        curves: Given curves.
        name: Name of the cell.
        form: Form of the open-circuit voltage.
        capacity_ah: Capacity with which the SOC is counted [Ah]; None: capacity from a full slow discharge.
        initial_soc: SOC 0..1 at the first sample of the captures without a ``start`` that start at the highest voltage; None: 1,
            if this is the voltage of a full cell.
        series_count: Cells in series; None: estimated from the median voltage.

    Raises:
        UserError: A capture cannot be used, the captures do not determine the curve, or nothing proves that they start with a
            full cell.
    """
    voltages_v = [_checked_voltage(recording) for recording in recordings]
    series_count = _cells_in_series(np.concatenate([*voltages_v, *(each.ocv_v for each in curves)]), series_count)
    soc = 1.0 if initial_soc is None else initial_soc
    sources = find_sources(recordings, curves, capacity_ah=capacity_ah, initial_soc=soc, series_count=series_count)
    # unpaired curves still contain the overpotential of RC pairs, which are known only with the generic cell
    preliminary_v = _fit_curve(form, sources.points)(NODES)
    generic = nearest_generic_cell(NODES, preliminary_v, sources.capacity_ah, series_count)
    if initial_soc is None:
        _require_full_start(recordings, sources.capacity_ah, generic, preliminary_v)
    ladder, elements = _elements(generic, sources, recordings)
    sources = subtract_rc_overpotential(sources, ladder)
    # the two phases of a plateau cause hysteresis, which the form chen-mora does not have
    if form is OcvForm.TABLE and sources.hysteresis_v is None and has_plateau(NODES, preliminary_v, series_count):
        sources = center_on_typical_hysteresis(sources, np.interp(NODES, *generic_curve(generic, "hysteresis_v")))
    fit = _fit_curve(form, sources.points)
    if isinstance(fit, TableFit) and fit.per_kelvin_v is None:
        fit = replace(fit, per_kelvin_v=_given_coefficient(curves))
    _check_ends(fit, sources)
    sections = _cell_and_ocv_sections(name, series_count, fit, sources, recordings)
    cell = CellModel.model_validate({**sections, "ladder": ladder, **elements})
    return OcvCell(cell, fit, sources, generic)


def _require_full_start(
    recordings: Sequence[Recording], capacity_ah: float, generic: CellModel, preliminary_v: Floats
) -> None:
    """Check that the captures without a known SOC start with a full cell, by the highest voltage of a first rest.

    Args:
        recordings: Captures.
        capacity_ah: Capacity of the cell [Ah].
        generic: Generic cell of the most similar chemistry.
        preliminary_v: OCV at ``NODES``, if the captures start with a full cell [V].

    Raises:
        UserError: They start with a lower voltage, or with that of a full cell whose OCV curve has another shape.
    """
    starts = [
        (initial_rest_v(each.samples, each.name, capacity_ah), each.name)
        for each in recordings
        if each.start is None and _discharged_ah(each) > MIN_DISCHARGED_SOC * capacity_ah
    ]
    finite = [(start_v, name) for start_v, name in starts if np.isfinite(start_v)]
    if not finite:
        return
    start_v, name = max(finite)
    series, grid = generic.cell.series_count, ocv_grid(generic)
    others = [ocv_grid(load_cell(each, capacity_ah).pack(series, 1)) for each in generic_cells()]
    is_ambiguous = any(AMBIGUOUS_SOC[0] < soc_from_ocv(start_v, *each) < AMBIGUOUS_SOC[1] for each in others)
    has_same_shape = has_plateau(NODES, preliminary_v, series) == has_plateau(NODES, ocv_of_each(NODES, *grid), series)
    if soc_from_ocv(start_v, *grid) < FULL_SOC or (is_ambiguous and not has_same_shape):
        raise UserError(
            f"--soc: not given, and nothing proves that the cell is full at the start of {name}: the first rest has "
            f"{start_v / series:.3f} V per cell; give the SOC at the start, which is 1 for a full cell"
        )


def _discharged_ah(recording: Recording) -> float:
    good = remove_glitches(recording.samples, recording.name)
    return float(charge_ah(good["time_s"], good["current_a"]).max())


def _fit_curve(form: OcvForm, points: Points) -> ChenMoraFit | TableFit:
    return fit_table(points) if form is OcvForm.TABLE else fit_chen_mora(points)


def _given_coefficient(curves: Sequence[ExternalCurve]) -> Floats | None:
    """Return the mean temperature coefficient of given curves at ``NODES`` [V/K]; None if no curve has one."""
    given_v = [np.interp(NODES, each.soc, each.per_kelvin_v) for each in curves if each.per_kelvin_v is not None]
    return np.mean(given_v, axis=0) if given_v else None


def _checked_voltage(recording: Recording) -> Floats:
    """Return the voltage without glitches [V].

    Raises:
        UserError: The voltage is constant.
    """
    voltage_v = remove_glitches(recording.samples, recording.name)["voltage_v"]
    if np.ptp(voltage_v) == 0.0:
        raise UserError(f"{recording.name}: the voltage is {voltage_v[0]:g} V throughout: is the sensor connected?")
    return voltage_v


def _cells_in_series(voltage_v: Floats, configured: int | None) -> int:
    """Return the configured number of cells in series, or an estimate from the median voltage.

    Raises:
        UserError: The voltage of one cell would be implausible.
    """
    median_v = float(np.median(voltage_v))
    count = configured or max(round(median_v / TYPICAL_CELL_V), 1)
    if not configured and count > MAX_CELLS:
        raise UserError(
            f"the median voltage is {median_v:g} V, which would be {count} cells in series; if the column is in millivolts, "
            "convert it to volts, otherwise give --series"
        )
    if not MIN_CELL_V <= median_v / count <= MAX_CELL_V:
        raise UserError(f"--series {count}: {median_v:g} V would be {median_v / count:.2f} V per cell")
    return count


def _check_ends(fit: ChenMoraFit | TableFit, ocv_sources: OcvSources) -> None:
    """Check that the curve, extrapolated beyond its points, does not fall to 0 V.

    Raises:
        UserError: The OCV at SOC 0 is implausible.
    """
    empty_v, half_full_v = (float(v) for v in fit(np.array([0.0, 0.5])))
    if empty_v > MIN_EMPTY_RATIO * half_full_v:
        return
    raise UserError(
        f"the points begin at SOC {ocv_sources.points.soc[0]:.2f}, and their curve would be {empty_v:.2f} V at SOC 0: give captures "
        f"down to empty; if the cell was emptied, the capacity of {ocv_sources.capacity_ah:g} Ah is too large (--capacity-ah)"
    )


def _elements(
    generic: CellModel, ocv_sources: OcvSources, recordings: Sequence[Recording]
) -> tuple[Ladder, dict[str, object]]:
    """Return resistances over SOC, and the thesis's parameters a1..a15 of R_s and two RC pairs by section of the file.

    Both come from the rests of the capture nearest to 25 °C; without rests, from the generic cell.
    """
    test = _nearest_to_reference(ocv_sources.tests)
    if test is None:
        return scaled_generic_ladder(generic, None), {element: getattr(generic, element) for element in ELEMENTS}
    samples = next(recording.samples for recording in recordings if recording.name == test.name)
    rest_elements = initial_elements(samples, test, ocv_sources.capacity_ah)
    temperature_c = float(np.nan_to_num(test.temperature_c, nan=REFERENCE_C))
    return scaled_generic_ladder(generic, rest_elements, temperature_c), dict(rest_elements.sections)


def _cell_and_ocv_sections(
    name: str, series_count: int, fit: ChenMoraFit | TableFit, ocv_sources: OcvSources, recordings: Sequence[Recording]
) -> dict[str, object]:
    """Return the section ``cell``, which contains the limits of a valid sample, and the section ``ocv``."""
    half_full_v, full_v = (float(v) for v in fit(np.array([0.5, 1.0])))
    empty_v = float(fit(np.array([0.0]))[0])
    peak_a = max((float(np.nanmax(np.abs(each.samples["current_a"]))) for each in recordings), default=0.0)
    cell = Cell(
        name=name,
        capacity_ah=round(ocv_sources.capacity_ah, 4),
        capacity_std=MEASURED_CAPACITY_STD if ocv_sources.capacity_ah == ocv_sources.measured_ah else None,
        series_count=series_count,
        nominal_voltage_v=round(half_full_v, 2),
        voltage_min_v=round(min(MIN_VOLTAGE_RATIO * half_full_v, empty_v), 2),
        voltage_max_v=round(MAX_VOLTAGE_RATIO * full_v, 2),
        current_max_a=round(max(MIN_CURRENT_LIMIT_C * ocv_sources.capacity_ah, PEAK_CURRENT_MARGIN * peak_a), 3),
    )
    ocv = fit.ocv if isinstance(fit, ChenMoraFit) else fit.table(ocv_sources.hysteresis_v, ocv_sources.hysteresis_std_v)
    return {"cell": cell, "ocv": ocv}


def _nearest_to_reference(tests: Sequence[RelaxationTest]) -> RelaxationTest | None:
    """Return the test nearest to 25 °C; the first test if none has a temperature."""
    distance_k = [np.nan_to_num(abs(test.temperature_c - REFERENCE_C), nan=np.inf) for test in tests]
    return tests[int(np.argmin(distance_k))] if tests else None
