"""Verdict on a cell model in plain sentences: how large its errors are, and what the captures do not show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import LONG_REST_S, ends_of_long_rests
from bms_estimator.calibration.validate import LOW_SOC, Validation
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel

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
MIN_WITHIN_BAND = 0.9
"""Minimum fraction of samples whose SOC lies within ±2 std. The fraction is 95 % for a normal distribution."""
USUAL_MIN_C, USUAL_MAX_C = 0.0, 45.0
"""Temperature range in which most manufacturers allow charge [°C]. Temperatures outside it are not reported as unknown."""
FULL_SOC = 0.95
"""SOC that counts as full, because a charge with a voltage limit ends below 1."""
MIN_LOAD_C_RATE = 0.05
"""Minimum C-rate of a load that shows resistances [1/h]. At C/20 the overpotential is a few millivolts."""


class Grade(StrEnum):
    """Quality of a model."""

    GOOD = "good"
    FAIR = "fair"
    POOR = "poor"


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
class SocErrors:
    """Errors of the estimated SOC against coulomb counting.

    Attributes:
        rms: RMS error, 0..1.
        within_band: Fraction of the samples whose error is at most 2 std.
    """

    rms: float
    within_band: float


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
        grade: Grade of the voltage errors.
        sentences: Sentences on the errors.
        unknown: Conditions that the captures do not cover, such as ``below 10 °C``.
    """

    grade: Grade
    sentences: tuple[str, ...]
    unknown: tuple[str, ...]

    @property
    def text(self) -> str:
        """All sentences, with the unknown conditions at the end."""
        return " ".join([*self.sentences, *([f"Not known: {'; '.join(self.unknown)}."] if self.unknown else [])])


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


def judge(errors: VoltageErrors, covered: Coverage, soc_errors: SocErrors | None = None) -> Verdict:
    """Return the verdict on a model.

    Args:
        errors: Errors of the modeled voltage, preferably on captures that were not used in the fit.
        covered: Operating ranges of all captures.
        soc_errors: Errors of the estimated SOC; None if no estimator was run.
    """
    grade = grade_voltage(errors)
    return Verdict(grade, tuple(_sentences(grade, errors, soc_errors)), tuple(_unknown_conditions(covered)))


def grade_voltage(errors: VoltageErrors) -> Grade:
    """Return the grade of the voltage errors. Both the RMS and the mean error must be within a grade's limits."""
    if errors.rms_v <= GOOD_RMS_V and errors.mean_percent <= GOOD_PERCENT:
        return Grade.GOOD
    return Grade.FAIR if errors.rms_v <= FAIR_RMS_V and errors.mean_percent <= FAIR_PERCENT else Grade.POOR


def grade_soc(errors: SocErrors) -> Grade:
    """Return the grade of the SOC errors."""
    if errors.rms <= GOOD_SOC:
        return Grade.GOOD
    return Grade.FAIR if errors.rms <= FAIR_SOC else Grade.POOR


def _soc_range(validations: Sequence[Validation]) -> tuple[float, float]:
    """Return the lowest and the highest SOC of the samples."""
    return _range(np.concatenate([validation.soc for validation in validations]))


def _range(values: Floats) -> tuple[float, float]:
    """Return the lowest and the highest value; NaN is ignored."""
    return float(np.nanmin(values)), float(np.nanmax(values))


def _sentences(grade: Grade, errors: VoltageErrors, soc_errors: SocErrors | None) -> list[str]:
    """Return the sentences on the errors."""
    low, high = max(errors.soc[0], LOW_SOC), errors.soc[1]
    sentences = []
    if math.isfinite(errors.rms_v):
        sentences.append(
            f"The model predicts the voltage within {_millivolts(errors.rms_v)} (RMS per cell, on average "
            f"{errors.mean_percent:.2g} % of the voltage) between SOC {100 * low:.0f} % and {100 * high:.0f} %: {grade}."
        )
    if math.isfinite(errors.low_soc_rms_v):
        sentences.append(f"Below SOC {100 * LOW_SOC:.0f} % the error is {_millivolts(errors.low_soc_rms_v)}.")
    if soc_errors is not None:
        sentences.append(_soc_sentence(soc_errors))
    return sentences


def _soc_sentence(errors: SocErrors) -> str:
    sentence = f"The estimated SOC differs from coulomb counting by {100 * errors.rms:.1f} % (RMS): {grade_soc(errors)}"
    if errors.within_band >= MIN_WITHIN_BAND:
        return f"{sentence}."
    return f"{sentence}, but its ±2 std band is too narrow: only {100 * errors.within_band:.0f} % of the samples are inside."


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
    """Return the usual temperatures that the captures, between two temperatures [°C], do not cover."""
    below, above = low_c > USUAL_MIN_C, high_c < USUAL_MAX_C
    if below and above and round(low_c) == round(high_c):
        return [f"temperatures other than {low_c:.0f} °C"]
    return [*([f"below {low_c:.0f} °C"] if below else []), *([f"above {high_c:.0f} °C"] if above else [])]


def _unknown_currents(direction: str, c_rate: float) -> str:
    """Return the currents of a direction that captures with at most ``c_rate`` do not cover."""
    return direction if c_rate < MIN_LOAD_C_RATE else f"{direction} above {c_rate:.2g} C"


def _millivolts(volts: float) -> str:
    """Return a voltage in millivolts with two significant digits, or without decimals from 0.1 V on."""
    return f"{1e3 * volts:.2g} mV" if volts < 0.0995 else f"{1e3 * volts:.0f} mV"  # .2g would round 0.0995 V to 1e+02
