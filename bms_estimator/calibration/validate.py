"""Validation of a cell on a capture: open-loop simulation with constant parameters, and errors of the estimated SOC.

Section 5.3 and chapter 6 of the thesis validate in this way. (2.2)-(2.9) of the thesis are the model of Chen and Mora:
two RC pairs and a series resistance, whose elements are functions of SOC.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import (
    capture_contradictions,
    initial_soc as soc_of_first_rest,
    soc_outside,
)
from bms_estimator.calibration.cleaning.clean_capture import REST_C_RATE, CleanCapture, are_mismatched, clean_capture
from bms_estimator.calibration.elements.replay_score import MIN_SOC, SETTLING_S
from bms_estimator.calibration.ocv.overpotential import overpotential
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each
from bms_estimator.model.arrays import Floats, SampleBlock, SampleStatus
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from bms_estimator.pack.pack import Pack

GIVEN, FIRST_REST, UNDER_LOAD = "given", "first rest", "first sample under load"
"""Origins of the SOC at the first sample."""
LOW_SOC = 0.1
"""SOC below which (2.5)-(2.9) do not fit any measured cell. Errors are reported with and without that range."""


@dataclass(frozen=True)
class Errors:
    """Errors of the simulated voltage over a set of samples; NaN for an empty set.

    Attributes:
        samples: Number of samples.
        voltage_rms_v: Root mean square error [V].
        mean_abs_percent: Mean absolute error relative to the measured voltage [%].
        max_abs_percent: Maximum absolute error relative to the measured voltage [%].
    """

    samples: int
    voltage_rms_v: float
    mean_abs_percent: float
    max_abs_percent: float


@dataclass(frozen=True)
class Validation:
    """Result of the validation of one cell on one capture.

    Attributes:
        samples: Number of samples in the capture.
        glitches: Number of dropped glitches.
        initial_soc: SOC at the first sample that was used, 0..1.
        initial_soc_from: ``given``, ``first rest`` or ``first sample under load``.
        final_soc: SOC at the last sample by coulomb counting.
        all: Errors over all samples.
        above: Errors over the samples at SOC above ``LOW_SOC``.
        resting: Errors over the samples of ``above`` without current, caused by the OCV and the relaxation.
        loaded: Errors over the samples of ``above`` with current.
        extra_ohm: Additional series resistance that minimizes the errors ``above`` [ohm]. Its cause may be a contact,
            the temperature or age.
        with_extra_ohm: Errors over the samples of ``above`` that remain after ``extra_ohm`` was added to the model.
        warnings: Contradictions between capture and cell.
        time_s: Shape (n,), times of the good samples, from 0 [s].
        current_a: Shape (n,), positive on discharge [A].
        voltage_v: Shape (n,), measured [V].
        temperature_c: Shape (n,), temperature of the cell [°C]; NaN where it was not measured.
        error_v: Shape (n,), measured less simulated voltage [V].
        soc: Shape (n,), SOC by coulomb counting.
    """

    samples: int
    glitches: int
    initial_soc: float
    initial_soc_from: str
    final_soc: float
    all: Errors
    above: Errors
    resting: Errors
    loaded: Errors
    extra_ohm: float
    with_extra_ohm: Errors
    warnings: tuple[str, ...]
    time_s: Floats
    current_a: Floats
    voltage_v: Floats
    temperature_c: Floats
    error_v: Floats
    soc: Floats

    @property
    def named_errors(self) -> dict[str, Errors]:
        """Errors of the non-empty sets of samples by name. The sets after the second are parts of the second."""
        named = {
            "all": self.all,
            f"SOC > {LOW_SOC:g}": self.above,
            "at rest": self.resting,
            "under load": self.loaded,
            f"with {1e3 * self.extra_ohm:+.2f} mohm in series": self.with_extra_ohm,
        }
        return {name: errors for name, errors in named.items() if errors.samples}

    @property
    def modeled_v(self) -> Floats:
        """Shape (n,), simulated voltage [V]."""
        return self.voltage_v - self.error_v


def validate(capture: Columns, cell: CellModel, *, initial_soc: float | None = None, from_s: float = 0.0) -> Validation:
    """Simulate a capture's voltage from its current alone and compare it with the measured voltage.

    The simulation uses the RC ladder of the cell file at the capture's temperature, or (2.2)-(2.9) without a ladder.
    Near empty the model's C_ts and C_tl are negative. They are replaced with a small positive value, so that the
    simulation continues.

    Args:
        capture: Raw samples, rows of dtype ``SAMPLE``; it should start from rest.
        cell: Cell to validate.
        initial_soc: SOC 0..1 at the first good sample; None: from the voltage of the first rest.
        from_s: Time since the first good sample after which the errors are evaluated [s]. The simulation begins before.

    Raises:
        UserError: Most samples lie outside the cell's limits, or SOC runs outside 0..1.
    """
    clean = clean_capture(capture.name, capture.rows, cell)
    start = soc_of_first_rest(clean, cell) if initial_soc is None else initial_soc
    warnings = capture_contradictions(clean, cell, start)
    outside = soc_outside(clean, cell, start)
    if outside:
        raise UserError("\n".join(dict.fromkeys([*warnings, f"{capture.name}: {outside}"])))
    soc = start - clean.discharged_ah / cell.cell.capacity_ah
    grid = ocv_grid(cell)
    error_v = clean.voltage_v - ocv_of_each(soc, *grid) + overpotential(cell, clean, soc)
    clean, soc, error_v = _select_evaluated(clean, soc, error_v, from_s)
    above = soc > LOW_SOC
    resting = np.abs(clean.current_a) < REST_C_RATE * cell.cell.capacity_ah
    current_a = clean.current_a[above]
    extra_ohm = -float(error_v[above] @ current_a) / max(float(current_a @ current_a), 1e-12)
    measured_from = FIRST_REST if clean.resting_samples else UNDER_LOAD
    return Validation(
        samples=clean.samples,
        glitches=clean.glitches,
        initial_soc=start,
        initial_soc_from=measured_from if initial_soc is None else GIVEN,
        final_soc=float(soc[-1]),
        all=_errors(error_v, clean.voltage_v),
        above=_errors(error_v[above], clean.voltage_v[above]),
        resting=_errors(error_v[above & resting], clean.voltage_v[above & resting]),
        loaded=_errors(error_v[above & ~resting], clean.voltage_v[above & ~resting]),
        extra_ohm=extra_ohm,
        with_extra_ohm=_errors(error_v[above] + extra_ohm * current_a, clean.voltage_v[above]),
        warnings=tuple(warnings),
        time_s=clean.time_s,
        current_a=clean.current_a,
        voltage_v=clean.voltage_v,
        temperature_c=clean.temperature_c,
        error_v=error_v,
        soc=soc,
    )


def _select_evaluated(
    clean: CleanCapture, soc: Floats, error_v: Floats, from_s: float
) -> tuple[CleanCapture, Floats, Floats]:
    """Return the samples after ``from_s`` whose voltage belongs to their current."""
    chosen = (clean.time_s >= from_s) & ~clean.mismatched
    if chosen.all():  # no copy, because a long capture is large
        return clean, soc, error_v
    names = ("time_s", "current_a", "voltage_v", "temperature_c", "discharged_ah", "mismatched")
    return replace(clean, **{name: getattr(clean, name)[chosen] for name in names}), soc[chosen], error_v[chosen]


def _errors(error_v: Floats, voltage_v: Floats) -> Errors:
    if error_v.size == 0:
        return Errors(0, float("nan"), float("nan"), float("nan"))
    percent = np.abs(error_v)
    percent *= 100.0
    percent /= voltage_v
    return Errors(error_v.size, float(np.sqrt(np.mean(error_v**2))), float(percent.mean()), float(percent.max()))


BLOCK_SAMPLES = 1 << 16
"""Number of samples in a block. The trace of one block at a time is in memory."""

OnBlock = Callable[[TraceBlock, Floats, float], None]
"""Function that receives the trace of a block, the SOC by coulomb counting at its rows, and the processed fraction 0..1."""


def ignore_block(_trace: TraceBlock, _counted: Floats, _fraction: float) -> None:
    """Ignore a block."""


@dataclass(frozen=True)
class SocErrors:
    """Errors of the estimated SOC against coulomb counting.

    Attributes:
        rms: RMS error, 0..1; NaN without scored samples.
        within_band: Fraction of the scored samples whose error is at most 2 std; NaN without scored samples.
        samples: Number of scored samples.
        faults: Faults of the input that the estimator suspected at the end.
    """

    rms: float
    within_band: float
    samples: int
    faults: InputFault


def first_time_s(rows: SampleBlock) -> float:
    """Return the first finite time of the samples [s]."""
    return float(rows["time_s"][np.isfinite(rows["time_s"])][0])


def soc_errors(pack: Pack, rows: SampleBlock, validation: Validation, on_block: OnBlock = ignore_block) -> SocErrors:
    """Run a pack over the samples of a validation, and compare its SOC with coulomb counting.

    The first ``SETTLING_S`` are not scored, because the estimator searches its initial SOC. SOCs below ``MIN_SOC`` are not
    scored either. If voltage and current of a sample belong to different sides of a step, the voltage is marked as held.
    Otherwise the resistance would seem to be 0 or negative.

    Args:
        pack: New pack that has processed no samples.
        rows: All samples of the capture, dtype ``SAMPLE``.
        validation: Validation of the capture. If it begins later than the capture, the estimator begins there as well.
        on_block: Receives each block of the trace.
    """
    first_s, start_s = first_time_s(rows), float(validation.time_s[0])
    if start_s > 0.0:
        rows = rows[rows["time_s"] - first_s >= start_s]
    squares, within, samples = 0.0, 0, 0
    for begin in range(0, rows.size, BLOCK_SAMPLES):
        block = rows[begin : begin + BLOCK_SAMPLES]
        trace = pack.run(_with_held_voltages(block)).trace
        time_s = trace["time_s"] - first_s
        counted = np.interp(time_s, validation.time_s, validation.soc)
        scored = (time_s - start_s >= SETTLING_S) & (counted >= MIN_SOC)
        error = (trace["soc"] - counted)[scored]
        squares += float(error @ error)
        within += int(np.count_nonzero(np.abs(error) <= 2.0 * trace["soc_std"][scored]))
        samples += error.size
        on_block(trace, counted, (begin + block.size) / rows.size)
    faults = InputFault(int(pack.estimator.record[0]["checks"]["suspects"]))
    if samples == 0:
        return SocErrors(math.nan, math.nan, 0, faults)
    return SocErrors(math.sqrt(squares / samples), within / samples, samples, faults)


def _with_held_voltages(rows: SampleBlock) -> SampleBlock:
    """Return the samples with ``VOLTAGE_HELD`` where voltage and current belong to different sides of a step."""
    finite = np.flatnonzero(
        np.isfinite(rows["time_s"]) & np.isfinite(rows["current_a"]) & np.isfinite(rows["voltage_v"])
    )
    mismatched = finite[are_mismatched(rows[finite])]
    if not mismatched.size:
        return rows
    marked = rows.copy()
    marked["status"][mismatched] |= np.uint32(SampleStatus.VOLTAGE_HELD)
    return marked
