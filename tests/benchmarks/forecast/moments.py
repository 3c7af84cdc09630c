"""Moments of a discharge at which a forecast is made, with what was known then and the time that was left."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.forecast.forecast import Forecast
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.forecast.truth import Discharge

INTERVAL_S = 60.0
"""Interval between two moments [s]."""
LOWEST_V_S = 600.0
"""Time over which the lowest voltage is taken [s]."""
SLOPE_S = 60.0
"""Length of each of the two windows whose mean voltages give dV/dt [s]."""


@dataclass(frozen=True)
class Moment:
    """Forecast at one moment of a discharge."""

    time_s: float
    """Time stamp of the sample [s]."""
    forecast: Forecast
    left_s: float
    """True time to the cut-off [s]."""
    lowest_v: float
    """Lowest voltage of the last ``LOWEST_V_S`` [V]."""
    slope_v_per_s: float
    """dV/dt between the mean voltages of the last two windows of ``SLOPE_S`` [V/s]."""
    samples: SampleBlock
    """All samples until this moment."""
    forecaster: Forecaster
    """Forecaster in the state of this moment, until the next moment is taken."""

    def value(self, name: str) -> float:
        """Return a present value of the forecast; NaN if unknown."""
        return float(self.forecast.values[name][0])


def moments(discharge: Discharge, cell: CellModel, interval_s: float = INTERVAL_S) -> Iterator[Moment]:
    """Yield the moments of a discharge. The first SOC is that of the OCV, as it is without a setting.

    Args:
        discharge: Samples until the cut-off.
        cell: Cell file of the estimator.
        interval_s: Interval between two moments [s].
    """
    estimator = Estimator(cell)
    return moments_of(Forecaster(estimator, estimator, cutoff_v=discharge.cutoff_v), discharge, interval_s)


def moments_of(forecaster: Forecaster, discharge: Discharge, interval_s: float) -> Iterator[Moment]:
    """Yield the moments of a discharge in the order of time, whole intervals before the cut-off.

    Args:
        forecaster: Forecaster before the first sample.
        discharge: Samples until the cut-off.
        interval_s: Interval between two moments [s].
    """
    samples, end_s = discharge.samples, discharge.end_s
    due_s = np.arange(end_s - interval_s, samples["time_s"][0], -interval_s)[::-1]
    start = 0
    for end in np.unique(np.searchsorted(samples["time_s"], due_s, side="right")).tolist():
        forecaster.run(samples[start:end])
        start = end
        time_s = float(samples["time_s"][end - 1])
        yield Moment(
            time_s,
            forecaster.forecast(),
            end_s - time_s,
            float(last(samples[:end], LOWEST_V_S)["voltage_v"].min()),
            voltage_slope(samples[:end]),
            samples[:end],
            forecaster,
        )


def last(samples: SampleBlock, duration_s: float) -> SampleBlock:
    """Return the samples of the last ``duration_s`` [s]. The last sample is always one of them."""
    time_s = samples["time_s"]
    begin = int(np.searchsorted(time_s, time_s[-1] - duration_s, side="right"))
    return samples[min(begin, samples.size - 1) :]


def voltage_slope(samples: SampleBlock) -> float:
    """Return dV/dt between the mean voltages of the last two windows of ``SLOPE_S`` [V/s]; NaN without both windows."""
    both = last(samples, 2.0 * SLOPE_S)
    is_late = both["time_s"] > both["time_s"][-1] - SLOPE_S
    if is_late.all():
        return float("nan")
    late_v, early_v = both["voltage_v"][is_late].mean(), both["voltage_v"][~is_late].mean()
    late_s, early_s = both["time_s"][is_late].mean(), both["time_s"][~is_late].mean()
    return float((late_v - early_v) / (late_s - early_s))
