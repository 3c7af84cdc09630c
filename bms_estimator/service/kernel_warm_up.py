"""Kernel warm-up: calls all kernels of a live run once, so that nothing compiles after the first sample."""

import gc

import numpy as np

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.trip import constant_trip
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.kernels.accumulators.publish_window import known_rows
from bms_estimator.model.arrays import NO_CELLS, SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import fit
from bms_estimator.pack_model.saved import neutral_fit
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.service.kernel_compilation import compile_kernels
from bms_estimator.settings.alarm_limits import MIN_CELLS
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import ChargeEnergy, ChargeEnergyMeter, Window
from bms_estimator.telemetry.state import remaining_capacity_ah

CELL = "chen_mora"
"""Cell file of the warm-up. Any file would do, because the kernels do not depend on the cell."""
WARM_UP_S = 330
"""Duration of the load with which the kernels of a forecast are called [s], longer than ``forecaster.MIN_LOAD_S``."""
SILENT_S = 1e6
"""Silence that raises the alarm ``link_lost`` [s]."""
COLLECT_AFTER = 50_000
"""Number of new objects after which garbage is collected while kernels compile. numba creates many objects that are never freed."""


def load_kernels() -> None:
    """Load the kernels of decoder, estimator and reports. A first start compiles them."""
    compile_kernels()
    thresholds = gc.get_threshold()
    gc.set_threshold(COLLECT_AFTER)
    try:
        _call_kernels()
    finally:
        gc.set_threshold(*thresholds)
    gc.collect()
    gc.freeze()  # a full garbage collection over numba's objects would stop the loop for 100 ms each time


def _call_kernels() -> None:
    cell = load_cell(CELL)
    estimator = compiled_estimator(Settings(), cell)
    sample = np.zeros(1, dtype=SAMPLE)
    sample["voltage_v"] = cell.cell.nominal_voltage_v
    trace = estimator.run(sample)
    ChargeEnergyMeter(ChargeEnergy(), 1.0).add(trace)
    Window().add(trace, 0.0)
    known_rows(trace, False)
    alarms = AlarmEvaluator(Settings(), estimator)
    alarms.evaluate(sample, trace, NO_CELLS, arrival_s=0.0)
    alarms.on_silence(SILENT_S, now_s=0.0, reason="", monotonic_s=0.0)
    alarms.evaluate_hooks((), passed_s=0.0, now_s=0.0)
    alarms.acknowledge(None)
    pack = cell.pack(MIN_CELLS, 1)
    CellEstimator(compiled_estimator(Settings(), pack)).run(sample, np.zeros((1, MIN_CELLS)), trace)
    estimator.add_prior(0.5, 0.1)
    estimator.set_soc(0.5)
    estimator.resume(0.0)
    make_parameters_payload(estimator, 0.0)
    SlowFit(estimator).adopt(neutral_fit())
    _load_fit_kernels(estimator)
    estimator.return_to_cell_file()
    remaining_capacity_ah(estimator)
    load_forecast_kernels()
    _ = FrameDecoder().clock_ppm  # a kernel computes the property


def _load_fit_kernels(estimator: Estimator) -> None:
    """Call the kernels of the slow fit once, with a history of one row."""
    row = np.zeros(1, HISTORY_ROW)
    row["reference_soc"] = np.nan
    fit(CellCurves(estimator.cell_file_settings), row)


def load_forecast_kernels() -> None:
    """Compile the kernels of a forecast, or load them from the cache, so that no sample waits for them."""
    cell = load_cell(CELL)
    estimator = Estimator(cell, initial_soc=0.5)
    samples = np.zeros(WARM_UP_S, SAMPLE)
    samples["time_s"], samples["temperature_c"] = np.arange(WARM_UP_S), 25.0
    samples["voltage_v"], samples["current_a"] = cell.cell.nominal_voltage_v, 0.1 * cell.cell.capacity_ah
    forecaster = Forecaster(estimator, cutoff_v=cell.cell.voltage_min_v)
    Pack(estimator, forecaster=forecaster).run(samples)
    forecaster.forecast()
    forecaster.given_load_curve(constant_trip("power_w", 1.0, 60.0).load)
