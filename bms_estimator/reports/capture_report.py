"""Report on captures and the model of their cell, with a table of its parameters, their estimates and a verdict on each."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from bms_estimator import plot
from bms_estimator.calibration.cleaning.capture_checks import ends_of_long_rests
from bms_estimator.calibration.cleaning.data_quality import DataQuality
from bms_estimator.calibration.thesis.prediction import open_circuit
from bms_estimator.calibration.validate import SocErrors, Validation
from bms_estimator.calibration.verdict import Run, Verdict, judge
from bms_estimator.estimator.stability_conditions import failed_conditions
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.plot.cell_curves import ELEMENTS, PAIRS, SocCurve, element_over_soc, stability_limits
from bms_estimator.reports.report_parts import Group, Plot, ReportPage, Section, number, small_plot
from bms_estimator.reports.thesis import printed_values

TABULATED_SOC = (0.2, 0.5, 0.8)
"""SOCs of the table."""
MAX_SOC_DISTANCE = 0.05
"""Maximum distance of an estimate's SOC from the SOC in the table."""
MAX_RELATIVE_STD = 0.5
"""Relative std above which a capture does not determine a parameter."""


def parameter_group(
    cell: CellModel, estimates: Mapping[str, Floats], capacity_ah: float, capacity_std_ah: float
) -> Group:
    """Return the table of circuit elements and capacity, with the stability of the elements as its remark.

    Args:
        cell: Cell that the estimates started from.
        estimates: Columns of the trace by name.
        capacity_ah: Learned capacity [Ah].
        capacity_std_ah: Standard deviation of the learned capacity [Ah].
    """
    rated_ah, rated_std = cell.cell.capacity_ah, cell.cell.capacity_std or math.nan
    capacity = _values_and_verdict(rated_ah, rated_std * rated_ah, capacity_ah, capacity_std_ah)
    rows = [*_element_rows(cell, estimates), ("capacity [Ah]", "", *capacity)]
    return Group(
        "Parameters",
        columns=("parameter", "SOC", "cell file", "std", "estimated", "std", "verdict"),
        rows=tuple(rows),
        remark="“agrees”: the difference is at most 2 standard deviations. “not determined”: the std of the estimate exceeds "
        f"{100 * MAX_RELATIVE_STD:.0f} % of its value. The std of the cell file is that between cells of its type. {_stability(cell)}",
    )


def _element_rows(cell: CellModel, estimates: Mapping[str, Floats]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each circuit element and SOC of the table."""
    relative_std = cell.ladder.std if cell.ladder else math.nan
    for name, (function, scale, label) in ELEMENTS.items():
        curve = element_over_soc(estimates, name)
        for soc in TABULATED_SOC:
            from_file = scale * function(soc, cell.a[:16])
            value, std = _nearest(curve, soc)
            texts = _values_and_verdict(from_file, relative_std * from_file, scale * value, scale * std)
            yield (label, f"{100 * soc:.0f} %", *texts)


def _nearest(curve: SocCurve, soc: float) -> tuple[float, float]:
    """Return the estimate at the SOC nearest to ``soc``, and its std; NaN if it is farther than ``MAX_SOC_DISTANCE``."""
    distance = np.abs(curve.soc - soc)
    if distance.size == 0 or distance.min() > MAX_SOC_DISTANCE:
        return math.nan, math.nan
    nearest = int(np.argmin(distance))
    return float(curve.value[nearest]), float(curve.std[nearest])


def _values_and_verdict(from_file: float, file_std: float, value: float, std: float) -> tuple[str, ...]:
    return (
        number(from_file),
        number(file_std, 2),
        number(value),
        number(std, 2),
        verdict_on_parameter(from_file, file_std, value, std),
    )


def verdict_on_parameter(from_file: float, file_std: float, value: float, std: float) -> str:
    """Return the verdict on an estimate: ``not covered``, ``not determined``, ``agrees`` or ``differs``.

    Args:
        from_file: Value in the cell file.
        file_std: Standard deviation of ``from_file``; NaN if unknown.
        value: Estimate; NaN without one.
        std: Standard deviation of ``value``.
    """
    if not math.isfinite(value):
        return "not covered"
    if not std <= MAX_RELATIVE_STD * abs(value):
        return "not determined"
    known_std = file_std if math.isfinite(file_std) else 0.0
    return "agrees" if abs(value - from_file) <= 2.0 * math.hypot(known_std, std) else "differs"


def _stability(cell: CellModel) -> str:
    """Return sentences on the SOCs at which the capacitances become negative, and on the conditions of Lemma 4.1.1."""
    limits = {name: max(soc, 0.0) for name, soc in stability_limits(cell).items()}
    positive = "; ".join(
        f"{name.replace('c_', 'C_')} is positive above SOC {100 * soc:.1f} %" for name, soc in limits.items()
    )
    failed = failed_conditions(cell)
    conditions = (
        f"These required conditions fail: {', '.join(condition.name for condition in failed)}."
        if failed
        else "All required conditions hold."
    )
    return f"Stability (Lemma 4.1.1 of the thesis): {positive}. {conditions}"


@dataclass(frozen=True)
class Estimates:
    """Estimates of the service's estimator over a capture.

    Attributes:
        columns: Columns of the trace by name, thinned so that the extremes remain; ``time_s`` from 0 at the first sample.
        counted: SOC by coulomb counting at the same samples.
        soc_errors: Errors of the SOC.
        capacity_ah: Learned capacity [Ah].
        capacity_std_ah: Standard deviation of the learned capacity [Ah].
        suspicions: Suspicions of the input at the end, one sentence each.
    """

    columns: Mapping[str, Floats]
    counted: Floats
    soc_errors: SocErrors
    capacity_ah: float
    capacity_std_ah: float
    suspicions: tuple[str, ...]


@dataclass(frozen=True)
class CaptureResult:
    """Results for one capture.

    Attributes:
        name: Name of the capture.
        validation: Comparison of the cell's model with the capture.
        estimates: Estimates over the capture.
        quality: Quality of the data.
        is_fitted: True if the model was fitted to the capture.
        decoder_counters: Counters of the decoder of a raw capture, such as CRC errors; empty for a table.
        clock_ppm: Rate error of the device's clock [1e-6]; None if unknown.
    """

    name: str
    validation: Validation
    estimates: Estimates
    quality: DataQuality
    is_fitted: bool
    decoder_counters: Mapping[str, int]
    clock_ppm: float | None

    @property
    def run(self) -> Run:
        """Comparison of the model with the capture, for the verdict."""
        return Run(self.name, self.validation, self.estimates.soc_errors, self.is_fitted)


def capture_report(
    cell: CellModel, results: Sequence[CaptureResult], written: str, verdict: Verdict | None = None
) -> ReportPage:
    """Return the report on captures.

    Args:
        cell: Model of a cell or of a whole pack that the captures were compared with.
        results: Results of each capture.
        written: Time at which the report is written.
        verdict: Verdict of the calibration that made the model; None: by ``results``.
    """
    has_verdicts = len(results) > 1 or verdict is not None
    verdict = verdict or judge([result.run for result in results], cell)
    names = ", ".join(result.name for result in results)
    ratings = cell.cell
    return ReportPage(
        title=f"{ratings.name}: report on {names if len(results) == 1 else f'{len(results)} captures'}",
        subtitle=f"Cell model {ratings.name}, {ratings.capacity_ah:g} Ah, {ratings.nominal_voltage_v:g} V. Captures: {names}.",
        grade=verdict.grade.value if verdict.grade else "",
        sentences=verdict.all_sentences,
        sections=tuple(
            _section(cell, result, position, has_verdict=has_verdicts) for position, result in enumerate(results, 1)
        ),
        written=written,
    )


def _section(cell: CellModel, result: CaptureResult, position: int, *, has_verdict: bool) -> Section:
    """Return the section of a capture.

    Args:
        cell: Cell that the capture was compared with.
        result: Results of the capture.
        position: Number of the section, which makes ids unique.
        has_verdict: True if the section has a verdict of its own, because the page's verdict is on other data.
    """
    validation = result.validation
    extent = (
        f"{result.quality.duration_s / 3600.0:.2f} h, {validation.samples:,} samples, SOC {100 * validation.initial_soc:.1f} % "
        f"({validation.initial_soc_from}) to {100 * validation.final_soc:.1f} % by coulomb counting."
    )
    return Section(
        title=result.name,
        sentences=(extent, *(judge([result.run], cell).sentences if has_verdict else ())),
        warnings=(*validation.warnings, *result.estimates.suspicions),
        groups=(
            _over_time(result, f"capture-{position}"),
            _errors(validation),
            _ocv(cell, validation, f"ocv-{position}"),
            _elements(cell, result.estimates, f"elements-{position}"),
            parameter_group(
                cell, result.estimates.columns, result.estimates.capacity_ah, result.estimates.capacity_std_ah
            ),
            _quality(result),
        ),
    )


def _over_time(result: CaptureResult, salt: str) -> Group:
    validation, estimates = result.validation, result.estimates
    columns = estimates.columns
    figures = {
        "Voltage, measured and modeled": lambda ax: plot.voltage(
            validation.time_s, validation.voltage_v, validation.modeled_v, ax=ax
        ),
        "Error of the modeled voltage": lambda ax: plot.voltage_error(validation.time_s, validation.error_v, ax=ax),
        "SOC with ±2 std": lambda ax: plot.soc(
            columns["time_s"], columns["soc"], columns["soc_std"], counted=estimates.counted, ax=ax
        ),
        "Current": lambda ax: plot.current(validation.time_s, validation.current_a, ax=ax),
    }
    if np.isfinite(validation.temperature_c).any():
        figures["Temperature"] = lambda ax: plot.temperature(validation.time_s, validation.temperature_c, ax=ax)
    return Group(
        "Over time",
        tuple(Plot(title, small_plot(draw, salt=f"{salt}-{title}")) for title, draw in figures.items()),
        remark="The model's voltage is simulated from the current alone (open loop). The SOC comes from the service's "
        "estimator, which also uses the voltage.",
    )


def _errors(validation: Validation) -> Group:
    averages = printed_values.TABLE_11.values()
    return Group(
        "Errors of the modeled voltage",
        columns=("samples at", "number", "RMS [mV]", "mean [%]", "largest [%]"),
        rows=tuple(
            (
                name.replace("mohm", "mΩ"),
                f"{errors.samples:,}",
                f"{1e3 * errors.voltage_rms_v:.2f}",
                f"{errors.mean_abs_percent:.3f}",
                f"{errors.max_abs_percent:.2f}",
            )
            for name, errors in validation.named_errors.items()
        ),
        remark="Errors in percent are absolute errors over the measured voltage, as in Table 11 of the thesis, whose averages "
        f"are {min(averages):.2f} to {max(averages):.2f} %. The last row adds the series resistance that fits the capture "
        "best, because contacts differ between captures.",
    )


def _ocv(cell: CellModel, validation: Validation, salt: str) -> Group:
    ends = np.array(ends_of_long_rests(validation.time_s, validation.current_a, cell.cell.capacity_ah), dtype=np.int64)
    soc, residual_v = validation.soc[ends], validation.error_v[ends]
    ocv_v = open_circuit(cell, soc) + residual_v
    curve = Plot("OCV", small_plot(lambda ax: plot.ocv(cell, soc, ocv_v, ax=ax), salt=f"{salt}-curve"))
    if ends.size == 0:
        return Group(
            "Open-circuit voltage", (curve,), remark="The capture has no rest that shows the open-circuit voltage."
        )
    residuals = small_plot(lambda ax: plot.ocv_residuals(cell, soc, residual_v, ax=ax), salt=f"{salt}-residuals")
    rms_mv = 1e3 * float(np.sqrt(np.mean(residual_v**2)))
    return Group(
        "Open-circuit voltage",
        (curve, Plot("Residuals of the OCV", residuals)),
        remark=f"Points are the ends of {ends.size} rests, at their SOC by coulomb counting; the relaxation that the model still expects there is subtracted. "
        f"They deviate by {rms_mv:.1f} mV RMS.",
    )


def _elements(cell: CellModel, estimates: Estimates, salt: str) -> Group:
    columns = estimates.columns
    elements = {name: partial(plot.element, cell, name, columns) for name in ELEMENTS}
    products = {f"RC product {pair}": partial(plot.rc_product, cell, pair, columns) for pair in PAIRS}
    figures = [
        Plot(title, small_plot(partial(_draw_on, draw), salt=f"{salt}-{title}"))
        for title, draw in (elements | products).items()
    ]
    return Group(
        "Circuit elements and RC products",
        tuple(figures),
        remark="Dashed: the cell file, at 25 °C. Solid: what the estimator learned from this capture, with ±2 std. Below a "
        "stability limit the capacitance of the cell file is negative.",
    )


def _draw_on(draw: Callable[..., object], ax: Any) -> None:
    """Draw on axes given by position, as ``small_plot`` passes them."""
    draw(ax=ax)


def _quality(result: CaptureResult) -> Group:
    quality = result.quality
    short_s, long_s = quality.period_percentiles_s
    rows = [
        ("samples", f"{quality.samples:,}, of which {quality.not_finite:,} without a finite time, current or voltage"),
        (
            "sample period",
            f"{number(quality.period_s, 3)} s (median); 98 % are between {number(short_s, 3)} and {number(long_s, 3)} s",
        ),
        (
            "gaps",
            f"{quality.gaps:,} much longer than the sample period; the longest interval is {number(quality.longest_gap_s, 3)} s",
        ),
        ("glitches", f"{result.validation.glitches:,} samples not used"),
        (
            "clock",
            f"{quality.backward_steps:,} steps back, {quality.repeated_times:,} repeated times{_clock_text(result.clock_ppm)}",
        ),
        ("voltage resolution", f"{number(1e3 * quality.voltage_resolution_v, 3)} mV"),
        ("current resolution", f"{number(1e3 * quality.current_resolution_a, 3)} mA"),
        (
            "temperature",
            f"in {100 * quality.temperature_fraction:.0f} % of the samples"
            if quality.temperature_fraction
            else "not measured",
        ),
        *((name.replace("_", " "), f"{count:,}") for name, count in result.decoder_counters.items() if count),
    ]
    return Group(
        "Data quality",
        columns=("", "in this capture"),
        rows=tuple(rows),
        is_text=True,
        remark="Resolution is the smallest difference between two values of the capture.",
    )


def _clock_text(clock_ppm: float | None) -> str:
    return "" if clock_ppm is None else f"; the device's clock deviates by {clock_ppm:+.0f} ppm"
