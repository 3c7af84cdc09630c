"""Creation of the forecaster of a pack from its settings."""

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.cutoff_voltage import load_cutoff_v
from bms_estimator.forecast.available_power import power_limits
from bms_estimator.forecast.forecaster import CellRunner, Forecaster
from bms_estimator.forecast.trip import constant_trip
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.model.sample import SAMPLE
from bms_estimator.pack_model.learning import SlowFit
from bms_estimator.service.kernel_subtrees import CELL
from bms_estimator.settings.pack import Settings

WARM_UP_S = 330
"""Duration of the load with which the kernels are warmed up [s]. It is longer than ``forecaster.MIN_LOAD_S``, below which there is no forecast."""


def new_forecaster(
    settings: Settings,
    cell: PackModel,
    estimator: Estimator,
    pack_model: SlowFit | None,
    cells: CellRunner | None = None,
) -> Forecaster | None:
    """Return the forecaster of a new estimator; None for a fuel cell, and without the identifier.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack.
        estimator: New estimator of the pack.
        pack_model: Slow fit of the estimator; None without one.
        cells: Estimators of the single cells, which the forecaster runs; None: no cell voltages.

    Raises:
        UserError: The cut-off voltage is not below the voltage of the full pack.
    """
    if not isinstance(cell, CellModel) or not estimator.identifying:
        return None
    return Forecaster(
        estimator,
        pack_model or estimator,
        cutoff_v=load_cutoff_v(settings, cell),
        limits=power_limits(settings, cell),
        cells=cells,
    )


def load_forecast_kernels() -> None:
    """Compile the kernels of a forecast, or load them from the cache, so that no sample waits for them."""
    cell = load_cell(CELL)
    estimator = Estimator(cell, initial_soc=0.5)
    samples = np.zeros(WARM_UP_S, SAMPLE)
    samples["time_s"], samples["temperature_c"] = np.arange(WARM_UP_S), 25.0
    samples["voltage_v"], samples["current_a"] = cell.cell.nominal_voltage_v, 0.1 * cell.cell.capacity_ah
    forecaster = Forecaster(estimator, estimator, cutoff_v=cell.cell.voltage_min_v)
    forecaster.run(samples)
    forecaster.forecast()
    forecaster.trip_curve(constant_trip("power_w", 1.0, 60.0).load)
