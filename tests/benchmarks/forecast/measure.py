"""Outcomes of the forecast and of the other methods at each moment of a capture."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.cell import CellModel
from tests.benchmarks.forecast import baselines
from tests.benchmarks.forecast.captures import PULSES, Case
from tests.benchmarks.forecast.moments import Moment, last, moments
from tests.benchmarks.forecast.scores import Outcome, lead
from tests.benchmarks.forecast.truth import Discharge

FORECAST, COUNT, HALF_HOUR, POWER = "forecast", "charge / mean current", "half an hour repeated", "constant power"
PERFECT, GIVEN = "perfect model", "true load given"
"""Names of the methods."""
MAX_LEFT_S = 7200.0
"""Time to the cut-off, by the capture or by the forecast, up to which the slow methods run [s]."""
EVERY = 2
"""Number of moments for each moment at which the slow methods run, besides those at ``LEADS_S``."""
LEADS_S = (3600.0, 1800.0, 1200.0, 600.0, 300.0, 120.0)
"""Times before the cut-off at which the forecasts are judged [s]."""
RATE_S = 600.0
"""Time before the cut-off of which the mean current is the C-rate of a discharge [s]."""
TEMPERATURE_TOLERANCE_K = 3.0
"""Distance from the temperatures of a cell file within which the file knows the temperature [K]."""


def outcomes_of_discharge(
    case: Case, discharge: Discharge, cell: CellModel, interval_s: float, *, has_baselines: bool
) -> Iterator[Outcome]:
    """Yield the outcomes of a discharge by the forecast and, if wanted, by the other methods.

    The slow methods do not run on pulses, whose rests make long loads.
    """
    for n, moment in enumerate(moments(discharge, cell, interval_s)):
        said = baselines.quantiles_of(moment.forecast)
        if np.isnan(said.p50_s):
            continue  # the forecast has a reason to say nothing
        ours = outcome(FORECAST, said, case, discharge, cell, moment)
        yield ours
        if has_baselines:
            yield from of_fast_baselines(ours, moment)
            is_due = n % EVERY == 0 or lead(*LEADS_S)(ours)
            if case.load != PULSES and is_due and min(moment.left_s, said.p50_s) < MAX_LEFT_S:
                yield from of_slow_baselines(ours, moment, discharge)


def outcome(
    method: str, said: baselines.Quantiles, case: Case, discharge: Discharge, cell: CellModel, moment: Moment
) -> Outcome:
    """Return the outcome of a method at a moment of a discharge."""
    return Outcome(
        method,
        case.name,
        case.file,
        case.load,
        case.is_phosphate,
        discharge.temperature_c if np.isfinite(discharge.temperature_c) else REFERENCE_C,
        knows_temperature(cell, discharge.temperature_c),
        baselines.mean_current(last(discharge.samples, RATE_S)) / case.recipe.capacity_ah,
        moment.left_s,
        moment.left_s,
        said,
    )


def of_fast_baselines(ours: Outcome, moment: Moment) -> Iterator[Outcome]:
    """Yield the outcomes of the methods that need little time."""
    for method, forecast in ((COUNT, baselines.charge_over_mean_current), (POWER, baselines.constant_power)):
        said = forecast(moment)
        if np.isfinite(said.p50_s):
            yield replace(ours, method=method, said=said)


def of_slow_baselines(ours: Outcome, moment: Moment, discharge: Discharge) -> Iterator[Outcome]:
    """Yield the outcomes of the methods that run the model forward second by second."""
    repeated = baselines.half_hour_repeated(moment)
    if np.isfinite(repeated.p50_s):
        yield replace(ours, method=HALF_HOUR, said=repeated)
    given = baselines.true_load_given(moment, discharge.load)
    if np.isfinite(given.p50_s):
        yield replace(ours, method=GIVEN, said=given)
        yield replace(ours, method=PERFECT, truth_s=max(baselines.drawn_truth(moment, given), 1.0))


def knows_temperature(cell: CellModel, temperature_c: float) -> bool:
    """Return True if the captures of the cell file had this temperature [C]. A file without temperatures is of 25 C."""
    if np.isnan(temperature_c):
        return True  # without a sensor the estimator assumes 25 C
    low_c, high_c = (REFERENCE_C, REFERENCE_C) if cell.ladder is None else cell.ladder.temperature_c
    return low_c - TEMPERATURE_TOLERANCE_K <= temperature_c <= high_c + TEMPERATURE_TOLERANCE_K
