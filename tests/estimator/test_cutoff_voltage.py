"""Voltage at which the load is switched off: defaults and limits."""

from typing import Any

import pytest

from bms_estimator.estimator.settings_plausibility import forecast_end_v
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings

PACK = load_cell("nmc", 10.0).pack(4, 1)
NO_ALARM = {"pack_under_voltage": {"enabled": False}}


@pytest.mark.parametrize(
    ("pack", "alarms", "expected_v"),
    [
        ({"cutoff_v": 13.0, "cutoff_voltage_v": 11.0}, {}, 13.0),
        ({"cutoff_voltage_v": 11.0}, {}, 11.0),
        ({}, {"pack_under_voltage": {"limit_v": 12.0}}, 12.0),
        ({}, {}, 4 * 2.7),  # default limit of the alarm
        ({}, NO_ALARM, 4 * 2.5),  # OCV at SOC 0
    ],
)
def test_the_first_known_voltage_is_the_cut_off(
    pack: dict[str, Any], alarms: dict[str, Any], expected_v: float
) -> None:
    settings = Settings.model_validate({"pack": pack, "alarms": alarms})
    assert forecast_end_v(settings, PACK) == pytest.approx(expected_v)


@pytest.mark.parametrize(
    ("pack", "full"), [({"cutoff_v": 16.8}, "16.8"), ({"cutoff_v": 16.5, "full_voltage_v": 16.4}, "16.4")]
)
def test_a_cut_off_at_the_voltage_of_the_full_pack_is_rejected(pack: dict[str, float], full: str) -> None:
    with pytest.raises(UserError, match=f"pack.cutoff_v = .*: must be below {full} V"):
        forecast_end_v(Settings.model_validate({"pack": pack}), PACK)
