"""Limits of the alarms ``collapse_risk`` and ``weak_cell`` by the accepted rate of false alarms."""

from itertools import pairwise

import numpy as np
import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import load_fuel_cell
from bms_estimator.settings.alarm_limits import WEAK_CELL_CLEAR_FRACTION, WEAK_CELL_STD, monitored_alarms
from bms_estimator.settings.false_alarm_limits import (
    COLLAPSE_FALSE_ALARMS,
    USE_H_PER_MONTH,
    collapse_limit,
    weak_cell_limit,
)
from bms_estimator.settings.pack import Settings


def test_the_limit_falls_with_the_accepted_rate_and_is_that_of_the_table_at_its_rates() -> None:
    limits = [collapse_limit(rate) for rate in np.geomspace(0.01, 1000.0, 200)]
    assert all(after <= before for before, after in pairwise(limits))
    assert (limits[0], limits[-1]) == (COLLAPSE_FALSE_ALARMS[0][1], COLLAPSE_FALSE_ALARMS[-1][1])
    for in_100_h, limit in COLLAPSE_FALSE_ALARMS:
        assert abs(collapse_limit(in_100_h * USE_H_PER_MONTH / 100.0) - limit) < 1e-9


def test_the_configured_rate_sets_the_limit_of_collapse_risk() -> None:
    pack = load_cell("nmc", 10.0).pack(2, 1)
    settings = Settings.model_validate({"alarms": {"collapse_risk": {"false_alarms_per_month": 5.0}}})
    limits = {each.name: each.limit for each in monitored_alarms(settings, pack)}
    assert limits["collapse_risk"] == collapse_limit(5.0)


def test_a_pack_without_a_forecast_does_not_monitor_collapse_risk() -> None:
    pack = load_cell("nmc", 10.0).pack(2, 1)
    without_identifier = Settings.model_validate({"identifier": {"enabled": False}})
    for settings, model in ((without_identifier, pack), (Settings(), load_fuel_cell("pem_30w"))):
        assert "collapse_risk" not in {each.name for each in monitored_alarms(settings, model)}


def weak_cell_limits(weak_cell: dict[str, object]) -> tuple[float, float]:
    settings = Settings.model_validate({"alarms": {"weak_cell": weak_cell}})
    alarms = monitored_alarms(settings, load_cell("nmc", 10.0).pack(6, 1))
    return next((each.limit, each.clear) for each in alarms if each.name == "weak_cell")


def test_the_default_limit_of_weak_cell_is_that_of_the_monitor() -> None:
    expected = WEAK_CELL_STD, WEAK_CELL_CLEAR_FRACTION * WEAK_CELL_STD
    assert weak_cell_limits({"severity": "critical"}) == pytest.approx(expected)


def test_more_accepted_false_alarms_lower_the_limit_of_weak_cell() -> None:
    limit, clear = weak_cell_limits({"false_alarms_per_month": 1.0})
    assert limit == weak_cell_limit(1.0) < WEAK_CELL_STD
    assert clear == pytest.approx(WEAK_CELL_CLEAR_FRACTION * limit)


def test_a_single_cell_does_not_monitor_weak_cell() -> None:
    alarms = monitored_alarms(Settings(), load_cell("nmc", 10.0))
    assert "weak_cell" not in {each.name for each in alarms}
