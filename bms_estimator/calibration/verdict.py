"""Verdict on a cell model in plain sentences: how large its errors are, and what the captures do not show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import LONG_REST_S, ends_of_long_rests
from bms_estimator.calibration.reference import reference_faults
from bms_estimator.calibration.validate import LOW_SOC, SocErrors, Validation
from bms_estimator.model.arrays import Floats, SampleBlock, capture_digest
from bms_estimator.model.cell import CellModel, Grade

GOOD_RMS_V = 0.010
"""Maximum RMS error of a good model, per cell [V]. Cell files that were fitted to captures of their own cell have 5 to
10 mV."""
FAIR_RMS_V = 0.030
"""Maximum RMS error of a fair model, per cell [V]. The OCV of an NMC or NCA cell rises by about 1 V over SOC, so that 30 mV
correspond to an SOC error of 3 %."""
GOOD_PERCENT = 0.5
"""Maximum mean error of a good model [% of the voltage]. The average errors in Table 11 of the thesis are 0.18 to 0.47 %."""
FAIR_PERCENT = 1.5
"""Maximum mean error of a fair model [% of the voltage]. It is the largest error of the thesis under steps (5.3.2)."""
GOOD_SOC = 0.02
"""Maximum RMS error of a good SOC estimate. Coulomb counting itself is uncertain by 1 to 2 %, because of the capacity."""
FAIR_SOC = 0.05
"""Maximum RMS error of a fair SOC estimate. Devices commonly keep a reserve of 5 %."""
UNGRADED = "No grade, because the coulomb counting that the model is compared with is not reliable."
"""Sentence of a verdict without a grade."""
MIN_WITHIN_BAND = 0.9
"""Minimum fraction of samples whose SOC lies within ±2 std. The fraction is 95 % for a normal distribution."""
USUAL_MIN_C, USUAL_MAX_C = 0.0, 45.0
"""Temperature range in which most manufacturers allow charge [°C]. Temperatures outside it are not reported as unknown."""
FULL_SOC = 0.95
"""SOC that counts as full, because a charge with a voltage limit ends below 1."""
MIN_LOAD_C_RATE = 0.05
"""Minimum C-rate of a load that shows resistances [1/h]. At C/20 the overpotential is a few millivolts."""


@dataclass(frozen=True)
class VoltageErrors:
    """Errors of the modeled voltage over all captures.

    Attributes:
        rms_v: RMS error at SOC above ``LOW_SOC``, per cell [V]; NaN without samples.
        mean_percent: Mean absolute error at SOC above ``LOW_SOC`` [% of the voltage]; NaN without samples.
        low_soc_rms_v: RMS error at SOC up to ``LOW_SOC``, per cell [V]; NaN without samples.
        soc: Lowest and highest SOC of the samples, 0..1.
    """

    rms_v: float
    mean_percent: float
    low_soc_rms_v: float
    soc: tuple[float, float]


@dataclass(frozen=True)
class Run:
    """Comparison of a model with one capture.

    Attributes:
        name: Name of the capture.
        validation: Validation of the model on the capture.
        soc_errors: Errors of the estimated SOC.
        is_fitted: True if the model was fitted to the capture.
    """

    name: str
    validation: Validation
    soc_errors: SocErrors
    is_fitted: bool = False


@dataclass(frozen=True)
class Coverage:
    """Operating ranges that captures cover.

    Attributes:
        soc: Lowest and highest SOC, 0..1.
        temperature_c: Lowest and highest temperature [°C]; None without a sensor.
        discharge_c_rate: Largest discharge current as a C-rate [1/h].
        charge_c_rate: Largest charge current as a C-rate [1/h].
        long_rests: Number of rests longer than ``LONG_REST_S``.
    """

    soc: tuple[float, float]
    temperature_c: tuple[float, float] | None
    discharge_c_rate: float
    charge_c_rate: float
    long_rests: int


@dataclass(frozen=True)
class Verdict:
    """Verdict on a model.

    Attributes:
        grade: Grade of the model by its voltage errors; None if an error of the reference prevents it.
        sentences: Sentences on the errors.
        unknown: Conditions that the captures do not cover, such as ``below 10 °C``.
    """

    grade: Grade | None
    sentences: tuple[str, ...]
    unknown: tuple[str, ...]

    @property
    def all_sentences(self) -> tuple[str, ...]:
        """All sentences, with the unknown conditions at the end."""
        if not self.unknown:
            return self.sentences
        return (*self.sentences, f"Not known, because the captures do not show it: {'; '.join(self.unknown)}.")

    @property
    def text(self) -> str:
        """All sentences in one paragraph."""
        return " ".join(self.all_sentences)


def voltage_errors(validations: Sequence[Validation], cell: CellModel) -> VoltageErrors:
    """Return the errors over all samples of the validations of ``cell``."""
    above = [validation.above for validation in validations if validation.above.samples]
    samples = sum(errors.samples for errors in above)
    squares = sum(errors.samples * errors.voltage_rms_v**2 for errors in above)
    percents = sum(errors.samples * errors.mean_abs_percent for errors in above)
    low_v = np.concatenate([validation.error_v[validation.soc <= LOW_SOC] for validation in validations])
    return VoltageErrors(
        rms_v=math.sqrt(squares / samples) / cell.cell.series_count if samples else math.nan,
        mean_percent=percents / samples if samples else math.nan,
        low_soc_rms_v=math.sqrt(float(np.mean(low_v**2))) / cell.cell.series_count if low_v.size else math.nan,
        soc=_soc_range(validations),
    )


def coverage(validations: Sequence[Validation], cell: CellModel) -> Coverage:
    """Return the operating ranges of the captures that ``validations`` of ``cell`` used."""
    capacity_ah = cell.cell.capacity_ah
    measured = [v.temperature_c for v in validations if np.isfinite(v.temperature_c).any()]
    return Coverage(
        soc=_soc_range(validations),
        temperature_c=_range(np.concatenate(measured)) if measured else None,
        discharge_c_rate=max(float(v.current_a.max()) for v in validations) / capacity_ah,
        charge_c_rate=-min(float(v.current_a.min()) for v in validations) / capacity_ah,
        long_rests=sum(len(ends_of_long_rests(v.time_s, v.current_a, capacity_ah)) for v in validations),
    )


def judge(runs: Sequence[Run], cell: CellModel, covered: Coverage | None = None) -> Verdict:
    """Return the verdict on a model.

    The grade comes from the captures to which the model was not fitted and whose reference has no error. An error of the
    reference can only increase the voltage errors, so that a good model keeps its grade.

    Args:
        runs: Comparisons of ``cell`` with captures, at least one.
        cell: The model.
        covered: Operating ranges of all captures; None: those of ``runs``.
    """
    covered = covered or coverage([run.validation for run in runs], cell)
    unfitted = [run for run in runs if not run.is_fitted]
    judged = unfitted or list(runs)
    faults = [reference_faults(run.validation, cell, GOOD_RMS_V, run.soc_errors.faults) for run in judged]
    sound = [run for run, found in zip(judged, faults, strict=True) if not any(f.affects_voltage for f in found)]
    errors = voltage_errors([run.validation for run in sound or judged], cell)
    grade: Grade | None = grade_voltage(errors)
    if not sound and grade is not Grade.GOOD:
        grade = None
    earlier = None if unfitted or cell.fit is None else cell.fit.grade
    sentences = _voltage_sentences(None if earlier else grade, errors, is_explained=grade is None and earlier is None)
    if unfitted and len(unfitted) < len(runs):
        fitted = ", ".join(run.name for run in runs if run.is_fitted)
        sentences.append(f"Not part of the grade, because the cell file was fitted to them: {fitted}.")
    elif not unfitted:
        sentences.append(_fitted_sentence(len(runs), earlier))
    for run, found in zip(judged, faults, strict=True):
        sentences += [fault.text if len(runs) == 1 else f"{run.name}: {fault.text}" for fault in found]
    comparable = [run.soc_errors for run, found in zip(judged, faults, strict=True) if not found]
    sentences += _soc_sentences(comparable, with_grade=earlier is None)
    return Verdict(earlier or grade, tuple(sentences), tuple(_unknown_conditions(covered)))


def is_fitted_to(cell: CellModel, samples: SampleBlock) -> bool:
    """Return True if the cell file was fitted to the capture with these samples. They must be complete and unchanged."""
    return cell.fit is not None and capture_digest(samples) in cell.fit.captures


def grade_voltage(errors: VoltageErrors) -> Grade:
    """Return the grade of the voltage errors. Both the RMS and the mean error must be within a grade's limits."""
    if errors.rms_v <= GOOD_RMS_V and errors.mean_percent <= GOOD_PERCENT:
        return Grade.GOOD
    return Grade.FAIR if errors.rms_v <= FAIR_RMS_V and errors.mean_percent <= FAIR_PERCENT else Grade.POOR


def grade_soc(rms: float) -> Grade:
    """Return the grade of an RMS error of the SOC, 0..1."""
    if rms <= GOOD_SOC:
        return Grade.GOOD
    return Grade.FAIR if rms <= FAIR_SOC else Grade.POOR


def _soc_range(validations: Sequence[Validation]) -> tuple[float, float]:
    """Return the lowest and the highest SOC of the samples."""
    return _range(np.concatenate([validation.soc for validation in validations]))


def _range(values: Floats) -> tuple[float, float]:
    """Return the lowest and the highest value; NaN is ignored."""
    return float(np.nanmin(values)), float(np.nanmax(values))


def _voltage_sentences(grade: Grade | None, errors: VoltageErrors, *, is_explained: bool) -> list[str]:
    """Return the sentences on the voltage errors.

    Args:
        grade: Grade of the errors; None: the sentences state no grade.
        errors: The errors.
        is_explained: True if an error of the reference explains the errors, so that the model gets no grade.
    """
    subject = (
        "The measured voltage differs from the model by" if is_explained else "The model predicts the voltage within"
    )
    low, high = max(errors.soc[0], LOW_SOC), errors.soc[1]
    sentences = [UNGRADED] if is_explained else []
    if math.isfinite(errors.rms_v):
        sentences.append(
            f"{subject} {_millivolts(errors.rms_v)} (RMS per cell, on average "
            f"{errors.mean_percent:.2g} % of the voltage) between SOC {100 * low:.0f} % and {100 * high:.0f} %"
            f"{f': {grade}' if grade else ''}."
        )
    if math.isfinite(errors.low_soc_rms_v):
        sentences.append(f"Below SOC {100 * LOW_SOC:.0f} % the error is {_millivolts(errors.low_soc_rms_v)}.")
    return sentences


def _fitted_sentence(captures: int, grade: Grade | None) -> str:
    """Return the sentence on captures to which the cell file was fitted, with its grade on data that were held back."""
    these = "this capture" if captures == 1 else "these captures"
    sentence = f"The cell file was fitted to {these}, so that its errors on other captures may be larger"
    return f"{sentence}; on data that were held back from the fit it was {grade}." if grade else f"{sentence}."


def _soc_sentences(errors: Sequence[SocErrors], *, with_grade: bool) -> list[str]:
    """Return the sentence on the SOC errors of captures, or nothing without scored samples."""
    scored = [each for each in errors if each.samples]
    samples = sum(each.samples for each in scored)
    if not samples:
        return []
    rms = math.sqrt(sum(each.samples * each.rms**2 for each in scored) / samples)
    within_band = sum(each.samples * each.within_band for each in scored) / samples
    grade = f": {grade_soc(rms)}" if with_grade else ""
    sentence = f"The estimated SOC differs from coulomb counting by {100 * rms:.1f} % (RMS){grade}"
    if within_band >= MIN_WITHIN_BAND:
        return [f"{sentence}."]
    return [f"{sentence}, but its ±2 std band is too narrow: only {100 * within_band:.0f} % of the samples are inside."]


def _unknown_conditions(covered: Coverage) -> list[str]:
    """Return the operating conditions that the captures do not cover."""
    unknown = []
    if covered.temperature_c is None:
        unknown.append("the effect of temperature, which was not measured")
    else:
        unknown += _unknown_temperatures(*covered.temperature_c)
    low, high = covered.soc
    if low > LOW_SOC:
        unknown.append(f"SOC below {100 * low:.0f} %")
    if high < FULL_SOC:
        unknown.append(f"SOC above {100 * high:.0f} %")
    unknown.append(_unknown_currents("discharge", covered.discharge_c_rate))
    unknown.append(_unknown_currents("charge", covered.charge_c_rate))
    if covered.long_rests == 0:
        unknown.append(f"relaxation, because there is no rest of {LONG_REST_S / 60.0:.0f} minutes")
    return unknown


def _unknown_temperatures(low_c: float, high_c: float) -> list[str]:
    """Return the usual temperatures that captures between ``low_c`` and ``high_c`` [°C] do not cover."""
    below, above = low_c > USUAL_MIN_C, high_c < USUAL_MAX_C
    if below and above and round(low_c) == round(high_c):
        return [f"temperatures other than {low_c:.0f} °C"]
    return [*([f"below {low_c:.0f} °C"] if below else []), *([f"above {high_c:.0f} °C"] if above else [])]


def _unknown_currents(direction: str, c_rate: float) -> str:
    """Return the currents of a direction that captures with currents up to ``c_rate`` do not cover."""
    return direction if c_rate < MIN_LOAD_C_RATE else f"{direction} above {c_rate:.2g} C"


def _millivolts(volts: float) -> str:
    """Return a voltage in millivolts with two significant digits, or without decimals from 0.1 V on."""
    return f"{1e3 * volts:.2g} mV" if volts < 0.0995 else f"{1e3 * volts:.0f} mV"  # .2g would round 0.0995 V to 1e+02
