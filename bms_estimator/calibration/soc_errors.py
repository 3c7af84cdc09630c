"""Errors of the estimated SOC of a capture against coulomb counting."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.mismatched_steps import are_mismatched
from bms_estimator.calibration.elements.replay_score import MIN_SOC, SETTLING_S
from bms_estimator.calibration.validate import Validation
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.model.arrays import Floats
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.sample import SampleBlock, SampleStatus
from bms_estimator.pack.pack import Pack

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
