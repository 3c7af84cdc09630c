"""Copy of a forecaster, from which another thread can forecast while samples still arrive."""

from copy import copy

from bms_estimator.forecast.forecaster import Forecaster


def copy_forecaster(forecaster: Forecaster) -> Forecaster:
    """Return a forecaster in the same state. Later samples do not change this state."""
    estimator = forecaster.estimator.bound_to_record(forecaster.estimator.record.copy())
    estimator.settings_record = estimator.settings_record.copy()  # the slow fit changes its curves
    estimator.settings = estimator.settings_record["observer"]
    other = copy(forecaster)
    other.estimator = estimator
    other.load = copy(forecaster.load)
    other.past = copy(forecaster.past)  # its arrays are never changed in place
    other.load.record = forecaster.load.record.copy()
    return other
