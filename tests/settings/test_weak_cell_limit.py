"""Limit of the alarm ``weak_cell`` by the accepted rate of false alarms."""

import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.settings.alarm_limits import WEAK_CELL_CLEAR_FRACTION, WEAK_CELL_STD, monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.weak_cell_limit import weak_cell_limit


def limits(weak_cell: dict[str, object]) -> tuple[float, float]:
    settings = Settings.model_validate({"alarms": {"weak_cell": weak_cell}})
    alarms = monitored_alarms(settings, load_cell("nmc", 10.0).pack(6, 1))
    return next((each.limit, each.clear) for each in alarms if each.name == "weak_cell")


def test_the_default_limit_is_that_of_the_monitor() -> None:
    expected = WEAK_CELL_STD, WEAK_CELL_CLEAR_FRACTION * WEAK_CELL_STD
    assert limits({"severity": "critical"}) == pytest.approx(expected)


def test_more_accepted_false_alarms_lower_the_limit() -> None:
    limit, clear = limits({"false_alarms_per_month": 1.0})
    assert limit == weak_cell_limit(1.0) < WEAK_CELL_STD
    assert clear == pytest.approx(WEAK_CELL_CLEAR_FRACTION * limit)


def test_a_single_cell_does_not_monitor_the_alarm() -> None:
    alarms = monitored_alarms(Settings(), load_cell("nmc", 10.0))
    assert "weak_cell" not in {each.name for each in alarms}
