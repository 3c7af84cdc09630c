"""Outcomes of the forecasts of a discharge."""

from collections.abc import Iterator

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.available_power import Forecast
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.pack.pack import Pack
from tests.benchmarks.forecast.captures import Case
from tests.benchmarks.forecast.scores import Outcome, Quantiles
from tests.benchmarks.forecast.truth import Discharge
from tests.benchmarks.recipes import charge_ah

RATE_S = 600.0
"""Time before the cut-off of which the mean current is the C-rate of a discharge [s]."""
TEMPERATURE_TOLERANCE_K = 3.0
"""Distance from the temperatures of a cell file within which the file knows the temperature [K]."""


def outcomes_of_discharge(case: Case, discharge: Discharge, cell: CellModel, interval_s: float) -> Iterator[Outcome]:
    """Yield the outcomes of a discharge, except at moments at which the forecast has a reason to say nothing."""
    rate_c = mean_current(discharge.samples) / case.recipe.capacity_ah
    temperature_c = discharge.temperature_c if np.isfinite(discharge.temperature_c) else REFERENCE_C
    is_known = knows_temperature(cell, discharge.temperature_c)
    for left_s, forecast in forecasts(discharge, cell, interval_s):
        values = forecast.values[0]
        said = Quantiles(*(float(values[f"time_to_cutoff{name}_s"]) for name in ("_p05", "", "_p95")))
        if np.isfinite(said.p50_s):
            yield Outcome(
                case.name, case.file, case.load, case.is_phosphate, temperature_c, is_known, rate_c, left_s, said
            )


def forecasts(discharge: Discharge, cell: CellModel, interval_s: float) -> Iterator[tuple[float, Forecast]]:
    """Yield forecasts whole intervals before the cut-off, each with the true time to the cut-off [s].

    The first SOC is that of the OCV, as it is without a setting.
    """
    estimator = Estimator(cell)
    forecaster = Forecaster(estimator, cutoff_v=discharge.cutoff_v)
    pack = Pack(estimator, forecaster=forecaster)
    samples, end_s = discharge.samples, discharge.end_s
    due_s = np.arange(end_s - interval_s, samples["time_s"][0], -interval_s)[::-1]
    start = 0
    for end in np.unique(np.searchsorted(samples["time_s"], due_s, side="right")).tolist():
        pack.run(samples[start:end])
        start = end
        yield end_s - float(samples["time_s"][end - 1]), forecaster.forecast()


def mean_current(samples: SampleBlock) -> float:
    """Return the mean current of the last ``RATE_S`` [A]."""
    time_s = samples["time_s"]
    recent = samples[min(int(np.searchsorted(time_s, time_s[-1] - RATE_S, side="right")), samples.size - 1) :]
    duration_s = float(recent["time_s"][-1] - recent["time_s"][0])
    return 3600.0 * float(charge_ah(recent)[-1]) / duration_s if duration_s > 0.0 else float(recent["current_a"][-1])


def knows_temperature(cell: CellModel, temperature_c: float) -> bool:
    """Return True if the captures of the cell file had this temperature [C]. A file without temperatures is of 25 C."""
    if np.isnan(temperature_c):
        return True  # without a sensor the estimator assumes 25 C
    low_c, high_c = (REFERENCE_C, REFERENCE_C) if cell.ladder is None else cell.ladder.temperature_c
    return low_c - TEMPERATURE_TOLERANCE_K <= temperature_c <= high_c + TEMPERATURE_TOLERANCE_K
