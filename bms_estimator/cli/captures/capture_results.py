"""Results for a capture in a report: validation, estimates and data quality."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.cleaning.data_quality import data_quality
from bms_estimator.calibration.validate import BLOCK_SAMPLES, Validation, first_time_s, soc_errors, validate
from bms_estimator.calibration.verdict import is_fitted_to
from bms_estimator.cli.options.capture_input import read_with_bar
from bms_estimator.cli.options.progress_bar import compile_ahead, progress_bar
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.model.arrays import Floats, SampleBlock, fill_temperature
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.plot.style import kept_indices
from bms_estimator.reports.capture_report import CaptureResult, Estimates
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.replay import Capture, RawCapture
from bms_estimator.telemetry.health import suspicions

ESTIMATE_POINTS = 6000
"""Maximum number of rows of the trace that remain after thinning."""
KEPT_EXTREMES = ("soc", "soc_std", "r_s_ohm", "r_ts_ohm", "r_tl_ohm", "tau_ts_s", "tau_tl_s")
"""Columns of the trace whose extremes remain after thinning."""


def capture_result(
    file: Path,
    name: str,
    opened: Capture,
    settings: Settings,
    model: CellModel,
    *,
    initial_soc: float | None,
    temperature_c: float | None,
) -> CaptureResult:
    """Return the results for a capture.

    Args:
        file: File of the capture.
        name: Name of the capture in the report.
        opened: The capture, at its beginning.
        settings: Settings of the estimator.
        model: Model of a cell or of a whole pack.
        initial_soc: SOC at the first sample, 0..1; None: from the voltage.
        temperature_c: Temperature of a capture without a sensor [°C]; None: the default of the model.

    Raises:
        UserError: The capture cannot be read, or does not belong to the cell.
    """
    compile_ahead()
    rows = read_with_bar(file, opened)
    quality = data_quality(rows)  # first, because it needs memory for copies of columns
    is_fitted = is_fitted_to(model, rows)
    fill_temperature(rows, temperature_c)
    validation = validate(Columns(rows, name), model, initial_soc=initial_soc)
    pack = new_pack(settings, model, has_forecasts=False)
    with progress_bar(f"estimating {name}") as bar:
        estimates = _estimate(pack, rows, validation, bar.update)
    raw = opened if isinstance(opened, RawCapture) else None
    return CaptureResult(
        name,
        validation,
        estimates,
        quality,
        is_fitted=is_fitted,
        decoder_counters=dict(raw.decoder.counters) if raw else {},
        clock_ppm=raw.decoder.clock_ppm if raw else None,
    )


def _estimate(pack: Pack, rows: SampleBlock, validation: Validation, progress: Progress) -> Estimates:
    """Run the pack over the samples of a capture.

    Raises:
        UserError: The estimator accepted no sample.
    """
    max_rows = max(ESTIMATE_POINTS * BLOCK_SAMPLES // rows.size, 1)
    traces, counted_socs = [], []

    def keep(trace: SampleBlock, counted_soc: Floats, fraction: float) -> None:
        kept = _thinned_indices(trace, max_rows)
        traces.append(trace[kept])
        counted_socs.append(counted_soc[kept])
        progress(fraction)

    estimator, errors = pack.estimator, soc_errors(pack, rows, validation, keep)
    if not any(trace.size for trace in traces):
        raise UserError("the estimator accepted no sample of the capture")
    trace = np.concatenate(traces)
    capacity = relative_capacity(estimator.record[0])
    rated_ah = float(estimator.settings["capacity_as"][0]) / 3600.0
    return Estimates(
        {name: trace[name] for name in trace.dtype.names or ()} | {"time_s": trace["time_s"] - first_time_s(rows)},
        np.concatenate(counted_socs),
        errors,
        capacity_ah=capacity.value * rated_ah,
        capacity_std_ah=capacity.std * rated_ah,
        suspicions=tuple(suspicions(estimator.record[0], estimator.settings_record[0])),
    )


def _thinned_indices(trace: SampleBlock, max_rows: int) -> NDArray[np.int64]:
    """Return the indices of the rows of a trace that remain, at most about ``max_rows``."""
    if trace.size <= max_rows:
        return np.arange(trace.size)
    return kept_indices(trace["time_s"], tuple(trace[column] for column in KEPT_EXTREMES), max_rows)
