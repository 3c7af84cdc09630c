"""Errors of the reference that a model is compared with: capacity, initial SOC and current of the coulomb counting."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import true_runs
from bms_estimator.calibration.validate import GIVEN, LOW_SOC, UNDER_LOAD, Validation
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.input_faults import InputFault

MAX_OUTSIDE = 0.02
"""Maximum distance of the counted SOC outside 0..1, the usual error of coulomb counting."""
MAX_UNEXPLAINED = 1.0 / 3.0
"""Maximum fraction of the voltage error that remains after a correction of the reference, if the reference is wrong. With a
wrong model, such as the generic cell of another chemistry, every correction leaves at least 40 % of the error."""
SIMILAR_ERROR = 1.5
"""Maximum remaining error of a correction that is reported together with the best one, relative to that of the best one.
During a discharge alone, a wrong capacity and an offset of the current have similar effects."""
START_SHIFT = 0.05
"""Error of the initial SOC that must be visible in the voltage of a capture."""
START_SHIFT_V = 0.010
"""Minimum change of the voltage by which a shift of the SOC is visible, per cell [V]. Good models have errors of this size."""
START_SHIFTS = np.linspace(-0.5, 0.5, 201)
"""Errors of the initial SOC that are tried."""
CAPACITY_RATIOS = np.linspace(0.6, 1.5, 181)
"""True capacities that are tried, relative to the capacity of the cell file."""
OFFSET_C_RATES = np.linspace(-0.05, 0.05, 201)
"""Offsets of the current that are tried, as a C-rate [1/h]."""
BASE_QUANTILE = 0.02
"""Quantile of the absolute current that estimates the current between the loads. It ignores a few smaller values."""
BASE_TOLERANCE = 0.2
"""Maximum deviation of a sample from the current between the loads, relative to this current."""
MIN_LOAD_FACTOR = 5.0
"""Minimum ratio of the largest current to the current between the loads. With a constant load, both are equal."""
MIN_BASE_PERIODS = 3
"""Minimum number of periods between loads."""
MIN_BASE_FRACTION = 0.1
"""Minimum fraction of the samples between loads."""
MAX_POINTS = 4000
"""Approximate number of samples for which corrections are tried."""
FAULTS = InputFault.SIGN_OF_CURRENT | InputFault.OFFSET | InputFault.CAPACITY | InputFault.VOLTAGE | InputFault.CURRENT
"""Faults of the input that make coulomb counting wrong."""


@dataclass(frozen=True)
class ReferenceFault:
    """Error of the coulomb counting that a model is compared with.

    Attributes:
        text: Sentence on the error and its remedy.
        affects_voltage: True if the error increases the error of the modeled voltage.
    """

    text: str
    affects_voltage: bool


@dataclass(frozen=True)
class _Correction:
    """Correction of the capacity, the initial SOC or the current.

    Attributes:
        text: Description, such as ``a capacity of about 3 Ah``.
        rms_v: RMS error of the voltage that remains, per cell [V].
    """

    text: str
    rms_v: float


def reference_faults(
    validation: Validation, cell: CellModel, good_rms_v: float, faults: InputFault
) -> list[ReferenceFault]:
    """Return the errors of the reference of a validation.

    Args:
        validation: Validation of ``cell`` on a capture.
        cell: Cell of the validation.
        good_rms_v: RMS error of the voltage up to which no explanation is searched, per cell [V].
        faults: Faults of the input that the estimator suspected.
    """
    curve = _Curve(validation, cell)
    text = _outside(validation, cell)
    errors = [ReferenceFault(text, affects_voltage=True)] if text else []
    text = _explanation(curve, validation, cell) if curve.rms_v(curve.soc) > good_rms_v else None
    if text:
        errors.append(ReferenceFault(text, affects_voltage=True))
    if not errors and curve.rms_v(curve.soc) > good_rms_v and (text := _constant_base_current(validation, cell)):
        errors.append(ReferenceFault(text, affects_voltage=True))
    if validation.initial_soc_from != GIVEN and not curve.depends_on_initial_soc():
        errors.append(ReferenceFault(_undetermined_start(validation), affects_voltage=False))
    if not errors and faults & FAULTS:
        errors.append(
            ReferenceFault(f"Coulomb counting is no reference: {(faults & FAULTS).text}.", affects_voltage=False)
        )
    return errors


class _Curve:
    """Open-circuit voltage of a cell along the counted SOC of a validation.

    Attributes:
        soc: Counted SOC of the samples.
        hours: Time of the samples since the start of the capture [h].
    """

    def __init__(self, validation: Validation, cell: CellModel) -> None:
        above = np.flatnonzero(validation.soc > LOW_SOC)
        kept = above[:: max(above.size // MAX_POINTS, 1)]
        self.soc, self.hours = validation.soc[kept], validation.time_s[kept] / 3600.0
        self._grid, self._series = ocv_grid(cell), cell.cell.series_count
        self._start_soc = np.array([validation.initial_soc])
        self._ocv_v = self._at(self.soc)
        self._error_v = validation.error_v[kept]

    def _at(self, soc: Floats) -> Floats:
        return ocv_of_each(soc, *self._grid)

    def rms_v(self, soc: Floats) -> float:
        """Return the RMS error of the voltage if the samples had the SOCs ``soc``, per cell [V]; 0 without samples."""
        if soc.size == 0:
            return 0.0
        error_v = self._error_v + self._ocv_v - self._at(soc)
        return float(np.sqrt(np.mean(error_v**2))) / self._series

    def start_depends_on_soc(self) -> bool:
        """Return True if the OCV at the start changes visibly with the SOC."""
        return self._is_visible(self._start_soc)

    def depends_on_initial_soc(self) -> bool:
        """Return True if the voltage at the start or over the capture changes visibly with the initial SOC."""
        return self.start_depends_on_soc() or self._is_visible(self.soc)

    def _is_visible(self, soc: Floats) -> bool:
        if soc.size == 0:
            return False
        changes_v = [self._at(soc + shift) - self._at(soc) for shift in (-START_SHIFT, START_SHIFT)]
        return min(float(np.sqrt(np.mean(v**2))) for v in changes_v) >= START_SHIFT_V * self._series


def _outside(validation: Validation, cell: CellModel) -> str | None:
    """Return a sentence if the counted SOC leaves 0..1."""
    low, high = float(validation.soc.min()), float(validation.soc.max())
    if low >= -MAX_OUTSIDE and high <= 1.0 + MAX_OUTSIDE:
        return None
    end = low if low < -MAX_OUTSIDE else high
    return (
        f"Coulomb counting gives an SOC of {100.0 * end:.0f} %, which no cell has: the capacity ({cell.cell.capacity_ah:.4g} Ah), "
        f"the SOC at the start ({100.0 * validation.initial_soc:.0f} %) or the current is wrong (--capacity-ah, --soc)."
    )


def _explanation(curve: _Curve, validation: Validation, cell: CellModel) -> str | None:
    """Return a sentence if a correction of the reference explains most of the voltage error."""
    corrections = [_capacity_correction(curve, validation, cell), _offset_correction(curve, cell)]
    if validation.initial_soc_from in {GIVEN, UNDER_LOAD} or not curve.start_depends_on_soc():
        corrections.append(_start_correction(curve, validation))
    limit_v = MAX_UNEXPLAINED * curve.rms_v(curve.soc)
    found = sorted((each for each in corrections if each and each.rms_v <= limit_v), key=lambda each: each.rms_v)
    if not found:
        return None
    texts = [each.text for each in found if each.rms_v <= SIMILAR_ERROR * found[0].rms_v]
    return (
        f"With {' or '.join(texts)}, the voltage error would be {1e3 * found[0].rms_v:.2g} mV: "
        "it is an error of the coulomb counting, not of the model."
    )


def _best_factor(curve: _Curve, factors: Floats, shift: Floats) -> tuple[int, float] | None:
    """Return the index of the factor with the smallest error and this error [V]; None if it is the first or the last factor.

    Args:
        curve: Samples.
        factors: Shape (m,), factors of ``shift``.
        shift: Shape (n,), change of the SOC of each sample by a correction.
    """
    errors_v = [curve.rms_v(curve.soc + factor * shift) for factor in factors]
    best = int(np.argmin(errors_v))
    return (best, errors_v[best]) if 0 < best < len(errors_v) - 1 else None


def _capacity_correction(curve: _Curve, validation: Validation, cell: CellModel) -> _Correction | None:
    best = _best_factor(curve, 1.0 / CAPACITY_RATIOS - 1.0, curve.soc - validation.initial_soc)
    if best is None:
        return None
    text = f"a capacity of about {cell.cell.capacity_ah * CAPACITY_RATIOS[best[0]]:.3g} Ah (--capacity-ah)"
    return _Correction(text, best[1])


def _offset_correction(curve: _Curve, cell: CellModel) -> _Correction | None:
    best = _best_factor(curve, OFFSET_C_RATES, curve.hours)
    if best is None:
        return None
    offset_a = OFFSET_C_RATES[best[0]] * cell.cell.capacity_ah
    direction = "lower" if offset_a > 0.0 else "higher"
    text = f"a current that is {abs(offset_a):.2g} A {direction} (check the zero of the current sensor)"
    return _Correction(text, best[1])


def _start_correction(curve: _Curve, validation: Validation) -> _Correction | None:
    best = _best_factor(curve, START_SHIFTS, np.ones(curve.soc.size))
    if best is None:
        return None
    soc = min(max(validation.initial_soc + START_SHIFTS[best[0]], 0.0), 1.0)
    return _Correction(f"an SOC of about {100.0 * soc:.0f} % at the start (--soc)", best[1])


def _constant_base_current(validation: Validation, cell: CellModel) -> str | None:
    """Return a sentence if the current between the loads is constant, but not 0, and its charge exceeds ``MAX_OUTSIDE``."""
    current_a = validation.current_a
    base_a = float(np.quantile(np.abs(current_a), BASE_QUANTILE)) * float(np.sign(np.median(current_a)) or 1.0)
    is_base = np.abs(current_a - base_a) <= BASE_TOLERANCE * abs(base_a)
    charge = abs(base_a) * float(validation.time_s[-1]) / 3600.0 / cell.cell.capacity_ah
    if (
        charge <= MAX_OUTSIDE
        or np.abs(current_a).max() < MIN_LOAD_FACTOR * abs(base_a)
        or len(true_runs(is_base)) < MIN_BASE_PERIODS
        or is_base.mean() < MIN_BASE_FRACTION
    ):
        return None
    return (
        f"The current between the loads is not 0, but {base_a:.2g} A. If the load was off there, this is an offset of the "
        f"current sensor, which moves the SOC by {100.0 * charge:.0f} % over the capture: check the zero of the sensor."
    )


def _undetermined_start(validation: Validation) -> str:
    return (
        f"The voltage of this capture does not determine its SOC at the start (about {100.0 * validation.initial_soc:.0f} %), "
        "so coulomb counting is no reference for the SOC: give it (--soc)."
    )
