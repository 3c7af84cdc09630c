"""Payloads of one publication."""

from typing import NamedTuple

from bms_estimator.model.payloads.alarm import Alarm
from bms_estimator.model.payloads.cells import CellsReport
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.forecast import ForecastReport
from bms_estimator.model.payloads.health import Health
from bms_estimator.model.payloads.info import Info
from bms_estimator.model.payloads.parameters import ParameterReport


class Snapshot(NamedTuple):
    """Payloads of one publication."""

    estimate: Estimate | None
    """Estimate of the window; None without a sample."""
    parameters: ParameterReport
    health: Health
    info: Info
    alarms: tuple[Alarm, ...] = ()
    """All alarms, raised or not."""
    forecast: ForecastReport | None = None
    """Curves of the last forecast; None before the first sample and without a forecaster."""
    cells: CellsReport | None = None
    """Comparison of the cells, made once a minute; None without cell voltages."""
