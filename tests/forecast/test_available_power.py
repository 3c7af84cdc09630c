"""Available power of packs with little knowledge: an unknown SOC, no rating, a first load."""

import math
from typing import Any

import numpy as np
import pytest

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.forecast.available_power import (
    QUANTILE_STDS,
    PowerLimits,
    PresentPower,
    power_limits,
    raise_to_present,
    unknown_values,
)
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.kernels.forecast.power import available_power, new_scratch
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.pack.pack import new_pack
from bms_estimator.settings.pack import Settings
from tests.estimator.simulated_cell import TRUTH

CAPACITY_AH, SERIES = 280.0, 16
"""Pack of 14 kWh."""
DISCHARGE = "available_discharge_power_10s_w", "available_discharge_power_60s_w"
CHARGE = "available_charge_power_10s_w", "available_charge_power_60s_w"
LIMITS = PowerLimits(discharge_a=100.0, charge_a=50.0)
CUTOFF_V = 44.8


def lfp_pack() -> CellModel:
    return load_cell("lfp", CAPACITY_AH).pack(SERIES, 1)


def lfp_forecaster(soc: float, seconds: int = 1800, current_a: float = 0.0, **pack: Any) -> Forecaster:
    """Return a forecaster of a pack with a generic cell file.

    It has processed ``seconds`` at rest at the OCV of ``soc``, and then 10 s with the current, if it is not 0. That is the
    shorter duration of an available power.
    """
    settings, cell = Settings.model_validate({"pack": pack}), lfp_pack()
    pack_ = new_pack(settings, cell, has_forecasts=False)
    block = np.zeros(seconds + (10 if current_a else 0), SAMPLE)
    block["time_s"], block["temperature_c"] = np.arange(block.size), 25.0
    block["current_a"][seconds:] = current_a
    ocv_v = ocv_grid(cell)[0]
    block["voltage_v"] = np.interp(soc, np.linspace(0.0, 1.0, ocv_v.size), ocv_v) - 0.005 * block["current_a"]
    pack_.run(block)
    assert pack_.forecaster
    return pack_.forecaster


def values(forecaster: Forecaster, names: tuple[str, str]) -> list[float]:
    return [float(forecaster.forecast().values[name][0]) for name in names]


def test_available_power_of_a_pack_without_limits_is_that_of_1_c_and_of_c_2_on_charge() -> None:
    """The current limit of the alarms, 5 C, would give 60 kW."""
    forecaster = lfp_forecaster(0.5)
    voltage_v = SERIES * 3.2
    assert values(forecaster, DISCHARGE) == pytest.approx([CAPACITY_AH * voltage_v] * 2, rel=0.03)
    assert values(forecaster, CHARGE) == pytest.approx([0.5 * CAPACITY_AH * voltage_v] * 2, rel=0.05)


@pytest.mark.parametrize(("current_a", "names"), [(450.0, DISCHARGE), (-220.0, CHARGE)])
def test_a_larger_current_that_the_pack_has_been_seen_with_raises_the_power(
    current_a: float, names: tuple[str, str]
) -> None:
    before, after = (values(lfp_forecaster(0.5, current_a=a), names) for a in (0.0, current_a))
    assert all(later > 1.3 * earlier for earlier, later in zip(before, after, strict=True))


@pytest.mark.parametrize("limit_a", [50.0, 200.0])
def test_given_limits_of_the_current_bound_the_power(limit_a: float) -> None:
    """A given limit counts also if it is larger than the currents that the pack has been seen with."""
    forecaster = lfp_forecaster(0.5, max_discharge_a=2.0 * limit_a, max_charge_a=limit_a)
    assert values(forecaster, DISCHARGE) == pytest.approx([2.0 * limit_a * SERIES * 3.2] * 2, rel=0.05)
    assert values(forecaster, CHARGE) == pytest.approx([limit_a * SERIES * 3.3] * 2, rel=0.05)


@pytest.mark.parametrize(
    ("soc", "seconds", "names"),
    [(0.3, 1, DISCHARGE), (0.46, 1, DISCHARGE), (0.3, 1, CHARGE), (0.7, 1, CHARGE), (0.9, 1800, CHARGE)],
)
def test_power_is_unknown_while_the_soc_is_too_uncertain(soc: float, seconds: int, names: tuple[str, str]) -> None:
    """The 5 % quantile would be 0 W, although the median is the power at the current limit.

    A sample at switch-on gives little information on the SOC. At an SOC of 0.9, half an hour at rest does not give enough.
    """
    assert all(math.isnan(value) for value in values(lfp_forecaster(soc, seconds), names))


def test_power_is_known_after_a_minute_of_rest_on_the_plateau() -> None:
    forecaster = lfp_forecaster(0.46, 60)
    assert min(values(forecaster, DISCHARGE) + values(forecaster, CHARGE)) > 7000.0


def test_small_power_for_another_reason_than_the_soc_is_known() -> None:
    """Near empty the errors of the generic curve alone make the quantile less than half the median."""
    forecaster = lfp_forecaster(0.03)
    estimator = forecaster.estimator
    state, settings = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    quantile_w, median_w = (
        available_power(state, settings, 10.0, forecaster.cutoff_v, CAPACITY_AH, stds, new_scratch())
        for stds in (QUANTILE_STDS, 0.0)
    )
    assert quantile_w < 0.5 * median_w
    assert values(forecaster, DISCHARGE)[0] == quantile_w


@pytest.mark.parametrize(
    ("present", "names", "power_w"),
    [
        (PresentPower(51.0, 40.0, 2040.0, 25.0), DISCHARGE, 2040.0),
        (PresentPower(51.0, 200.0, 10_200.0, 25.0), DISCHARGE, 5100.0),
        (PresentPower(CUTOFF_V, 40.0, 1792.0, 25.0), DISCHARGE, 10.0),
        (PresentPower(57.6, -20.0, -1152.0, 25.0), CHARGE, 1152.0),
        (PresentPower(57.6, -20.0, -1152.0, -5.0), CHARGE, 10.0),
        (PresentPower(53.0, 0.0, 0.0, 25.0), CHARGE, 10.0),
    ],
    ids=["supplies", "above its limit", "at the cut-off", "accepts", "too cold", "rests"],
)
def test_known_power_is_raised_to_the_present_power_within_the_limits(
    present: PresentPower, names: tuple[str, str], power_w: float
) -> None:
    power = unknown_values()
    for name in (*DISCHARGE, *CHARGE):
        power[name] = 10.0
    raise_to_present(power, present, LIMITS, CUTOFF_V)
    assert [float(power[name][0]) for name in names] == [power_w] * 2
    others = CHARGE if names == DISCHARGE else DISCHARGE
    assert [float(power[name][0]) for name in others] == [10.0] * 2


def test_unknown_power_stays_unknown_under_load() -> None:
    power = unknown_values()
    raise_to_present(power, PresentPower(51.0, 40.0, 2040.0, 25.0), LIMITS, CUTOFF_V)
    assert all(math.isnan(power[name][0]) for name in DISCHARGE)


def test_the_limits_of_a_pack_are_the_given_ones_and_those_of_its_alarms() -> None:
    settings = Settings.model_validate(
        {
            "pack": {"max_charge_a": 2.0},
            "alarms": {
                "discharge_over_current": {"limit_a": 7.0},
                "charge_over_current": {"enabled": False},
                "charging_below_freezing": {"limit_c": 5.0, "clear_c": 7.0},
            },
        }
    )
    limits = power_limits(settings, TRUTH)
    assert (limits.discharge_a, limits.charge_a, limits.charge_min_c) == (7.0, 2.0, 5.0)
    seen = limits.with_seen(discharge_a=9.0, charge_a=0.0)
    assert (seen.discharge_a, seen.charge_a) == (7.0, 2.0)
    unseen = limits.with_seen(discharge_a=0.0, charge_a=0.0)
    assert unseen.discharge_a == TRUTH.cell.capacity_ah
