"""Available power, usable capacity and time to full of simulated cells."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.forecast.available_power import QUANTILE_STDS, PowerLimits, cell_power_limits, unknown_values
from bms_estimator.forecast.capability import write_capability
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, RESISTANCES, TAUS
from bms_estimator.kernels.forecast.charge import charge_current, time_to_full
from bms_estimator.kernels.forecast.power import available_power, new_scratch
from bms_estimator.kernels.kalman_filter.records import STATES
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from tests.estimator.anchors.chargers import CAPACITY_AH, SERIES, Charged, Meter
from tests.estimator.simulated_cell import TRUTH, measured

CUTOFF_V, FULL_V = 2.8, 4.2


def rested(soc: float, temperature_c: float = 25.0) -> Estimator:
    """Return an estimator after half an hour of rest at ``soc`` and ``temperature_c``."""
    estimator = Estimator(TRUTH, initial_soc=soc)
    block = np.zeros(1800, SAMPLE)
    block["time_s"], block["temperature_c"] = np.arange(block.size), temperature_c
    block["voltage_v"] = chen_mora.ocv(soc, *ocv_grid(TRUTH))
    estimator.run(block)
    return estimator


def capability(estimator: Estimator, *, limits: PowerLimits | None = None, largest_a: float = 0.0) -> dict[str, float]:
    """Return available power, usable capacity and time to full by field name."""
    values = unknown_values()
    write_capability(values, estimator, CUTOFF_V, limits or cell_power_limits(estimator.cell), largest_a)
    return dict(zip(values.dtype.names, values[0].item(), strict=True))


def ideal(estimator: Estimator) -> tuple[np.void, np.void]:
    """Return state and settings of the filter, with the state set to that of a rested cell that equals its cell file."""
    state, settings = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    soc = float(state["mean"][state["best"], 0])
    state["count"], state["best"], state["ln_weight"][0] = 1, 0, 0.0
    state["mean"][0], state["x_a"] = np.zeros(STATES), 0.0
    state["mean"][0, 0] = soc
    return state, settings


def voltage_by_hand(estimator: Estimator, current_a: float, elapsed_s: float) -> float:
    """Return the voltage of an ideal cell at 25 C after a constant current [V]."""
    state, settings = ideal(estimator)
    soc = state["mean"][0, 0] - current_a * elapsed_s / settings["capacity_as"]
    grid = np.linspace(0.0, 1.0, len(settings["weak_ohm"]))
    ohm = [np.interp(soc, grid, column) for column in (settings["weak_ohm"] + settings["strong_ohm"]).T]
    drop_ohm = ohm[0] + sum(r * (1.0 - math.exp(-elapsed_s / tau_s)) for r, tau_s in zip(ohm[1:], TAUS, strict=True))
    return chen_mora.ocv(soc, settings["ocv_v"], settings["ocv_slope_v"]) - drop_ohm * current_a


@pytest.mark.parametrize("duration_s", [10.0, 60.0])
def test_the_median_power_is_that_of_the_current_whose_voltage_ends_at_the_cutoff(duration_s: float) -> None:
    estimator = rested(0.4)
    by_hand_a = brentq(lambda a: voltage_by_hand(estimator, a, duration_s) - CUTOFF_V, 0.0, 100.0)
    power_w = available_power(*ideal(estimator), duration_s, CUTOFF_V, 100.0, 0.0, new_scratch())
    assert power_w == pytest.approx(by_hand_a * CUTOFF_V, rel=1e-5)


def test_the_median_charge_power_is_that_of_the_current_whose_voltage_ends_at_the_full_voltage() -> None:
    estimator = rested(0.6)
    by_hand_a = brentq(lambda a: voltage_by_hand(estimator, a, 10.0) - FULL_V, -100.0, 0.0)
    power_w = available_power(*ideal(estimator), 10.0, FULL_V, -100.0, 0.0, new_scratch())
    assert power_w == pytest.approx(-by_hand_a * voltage_by_hand(estimator, by_hand_a, 0.0), rel=1e-5)


def lowest_voltage(power_w: float, duration_s: float, soc: float) -> float:
    """Return the lowest voltage of the true cell, rested at ``soc``, under constant power [V]."""
    ocv, a, x, lowest_v = ocv_grid(TRUTH), TRUTH.a, (soc, 0.0, 0.0), math.inf
    voltage_v = chen_mora.ocv(soc, *ocv)
    for _ in range(int(10 * duration_s)):
        current_a = power_w / voltage_v
        voltage_v = chen_mora.ocv(x[0], *ocv) - x[1] - x[2] - current_a * chen_mora.r_s(x[0], a)
        lowest_v = min(lowest_v, voltage_v)
        x = chen_mora.cell_step(x, current_a, 0.1, TRUTH.cell.capacity_ah * 3600.0, a)
    return lowest_v


@pytest.mark.parametrize("soc", [0.15, 0.3, 0.7])
@pytest.mark.parametrize("duration_s", [10.0, 60.0])
def test_the_promised_power_leaves_the_voltage_above_the_cutoff_and_twice_as_much_does_not(
    soc: float, duration_s: float
) -> None:
    promised_w = capability(rested(soc), limits=PowerLimits(100.0, 100.0))[
        f"available_discharge_power_{duration_s:.0f}s_w"
    ]
    assert lowest_voltage(promised_w, duration_s, soc) > CUTOFF_V
    assert lowest_voltage(2.0 * promised_w, duration_s, soc) < CUTOFF_V


def test_the_quantile_is_below_the_median() -> None:
    estimator = rested(0.4)
    state, settings = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    median_w, promised_w = (
        available_power(state, settings, 10.0, CUTOFF_V, 100.0, stds, new_scratch()) for stds in (0.0, QUANTILE_STDS)
    )
    assert 0.5 * median_w < promised_w < median_w


def test_more_soc_gives_more_discharge_power_and_less_charge_power() -> None:
    values = [capability(rested(soc)) for soc in (0.02, 0.1, 0.2, 0.5, 0.9, 0.98)]
    for duration in ("10s", "60s"):
        discharge_w = [each[f"available_discharge_power_{duration}_w"] for each in values]
        charge_w = [each[f"available_charge_power_{duration}_w"] for each in values]
        assert discharge_w == sorted(discharge_w)
        assert discharge_w[0] < discharge_w[-1]
        assert charge_w[-1] < charge_w[-2] < charge_w[2]


def test_cold_gives_less_power_and_less_usable_capacity() -> None:
    values = [capability(rested(0.5, celsius)) for celsius in (25.0, 10.0, 0.0, -10.0, -20.0)]
    for name in (
        "available_discharge_power_10s_w",
        "available_discharge_power_60s_w",
        "usable_capacity_ah",
        "remaining_energy_wh",
    ):
        numbers = [each[name] for each in values]
        assert numbers == sorted(numbers, reverse=True)
        assert numbers[-1] < numbers[0]


def test_a_longer_duration_gives_less_power() -> None:
    values = capability(rested(0.5), limits=PowerLimits(100.0, 100.0))
    assert 0.0 < values["available_discharge_power_60s_w"] < values["available_discharge_power_10s_w"]
    assert 0.0 < values["available_charge_power_60s_w"] < values["available_charge_power_10s_w"]


def test_no_charge_power_is_available_below_the_limit_of_the_temperature() -> None:
    cold, warm = capability(rested(0.5, -1.0)), capability(rested(0.5, 1.0))
    assert cold["available_charge_power_10s_w"] == cold["available_charge_power_60s_w"] == 0.0
    assert warm["available_charge_power_10s_w"] > 0.0
    assert cold["available_discharge_power_10s_w"] > 0.0


def test_the_current_limits_bound_the_power() -> None:
    values = capability(rested(0.8), limits=PowerLimits(2.0, 1.0))
    assert 2.0 * 3.5 < values["available_discharge_power_10s_w"] < 2.0 * 4.2
    assert 1.0 * 3.5 < values["available_charge_power_10s_w"] < 1.0 * 4.2


def test_usable_capacity_and_remaining_energy_are_charge_and_energy_that_a_constant_load_draws() -> None:
    current_a = 1.5
    block, true_soc = measured(np.full(8000, current_a), 0.9, np.random.default_rng(1))
    estimator = Estimator(TRUTH, initial_soc=0.9)
    estimator.run(block[:1200])
    end = int(np.argmax(block["voltage_v"] <= CUTOFF_V))
    true_ah = (true_soc[1200] - true_soc[end]) * TRUTH.cell.capacity_ah
    values = capability(estimator, largest_a=current_a)
    # The resistances of the simulated cell do not grow towards empty, as those of real cells do.
    assert values["usable_capacity_ah"] == pytest.approx(true_ah, rel=0.1)
    true_wh = float(np.sum((block["current_a"] * block["voltage_v"])[1200:end])) / 3600.0
    assert values["remaining_energy_wh"] == pytest.approx(true_wh, rel=0.1)


def test_a_varying_load_leaves_less_energy_per_charge_than_its_mean() -> None:
    energy_v = []
    for current_a in (np.full(1200, 1.0), np.where(np.arange(1200) % 2 == 0, 4.0, -2.0)):
        estimator = Estimator(TRUTH, initial_soc=0.8)
        estimator.run(measured(current_a, 0.8, np.random.default_rng(1))[0])
        values = capability(estimator)
        energy_v.append(values["remaining_energy_wh"] / values["usable_capacity_ah"])
    assert 0.9 * energy_v[0] < energy_v[1] < 0.99 * energy_v[0]


def test_a_peak_of_the_load_reduces_the_usable_capacity() -> None:
    without, with_peak = (capability(rested(0.5), largest_a=a)["usable_capacity_ah"] for a in (0.0, 4.0))
    assert 0.2 * without < with_peak < 0.95 * without


def test_the_time_to_full_of_constant_current_and_constant_voltage_is_the_true_one() -> None:
    cell = Charged("nmc", 0.5).charge(0.5, tail_c=0.05)
    samples = Meter().samples(cell)
    estimator = Estimator(load_cell("nmc", CAPACITY_AH).pack(SERIES, 1), initial_soc=0.5, voltage_resolution_v=0.01)
    begin = int(np.argmax(samples["current_a"] < -1.0))
    for moment in (begin + 600, begin + 3000):
        estimator.run(samples[samples["time_s"] <= moment][int(estimator.state["samples"][0]) :])
        to_full_s = capability(estimator)["time_to_full_s"]
        assert to_full_s == pytest.approx(samples.size - moment, rel=0.15)


@pytest.mark.parametrize("after_s", [300, 3200])
def test_the_time_to_full_of_a_fast_charge_of_lfp_cells_includes_the_constant_voltage_phase(after_s: int) -> None:
    """The simulated charge at 1C lasts for an hour, of which 20 min are at constant voltage."""
    samples = Meter().samples(Charged("lfp", 0.3).charge(1.0, tail_c=0.05))
    estimator = Estimator(load_cell("lfp", CAPACITY_AH).pack(SERIES, 1), initial_soc=0.3, voltage_resolution_v=0.01)
    moment = int(np.argmax(samples["current_a"] < -1.0)) + after_s
    estimator.run(samples[:moment])
    state, settings = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    scratch, charge_a = np.empty(RESISTANCES + BRANCHES), charge_current(state, settings)
    to_full_s = time_to_full(state, settings, charge_a, float(samples["voltage_v"].max()), 0.05 * CAPACITY_AH, scratch)
    assert to_full_s == pytest.approx(samples.size - moment, rel=0.4)


def test_a_charge_with_less_than_the_tail_current_ends_at_the_full_voltage() -> None:
    """With C/50 the overpotential is small, so that the charge ends close to SOC 1."""
    state, settings = ideal(rested(0.5))
    current_a = -TRUTH.cell.capacity_ah / 50.0
    to_full_s = time_to_full(state, settings, current_a, settings["ocv_v"][-1], 0.15, np.empty(RESISTANCES + BRANCHES))
    missing_s = (1.0 - state["mean"][0, 0]) * settings["capacity_as"] / -current_a
    assert to_full_s == pytest.approx(missing_s, rel=0.03)


def constant(current_a: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a constant current as a function of the time."""
    return lambda time_s: np.full(time_s.size, current_a)


@pytest.mark.parametrize(
    "current",
    [constant(0.0), constant(1.0), lambda t: np.where(t % 120.0 < 20.0, -2.0, 1.0)],
    ids=["rest", "discharge", "regeneration"],
)
def test_no_time_to_full_without_a_charge(current: Callable[[np.ndarray], np.ndarray]) -> None:
    estimator = Estimator(TRUTH, initial_soc=0.8)
    estimator.run(measured(current(np.arange(1215.0)), 0.8, np.random.default_rng(1))[0])
    assert charge_current(estimator.record[0]["filter"], estimator.settings_record[0]["filter"]) == 0.0
    assert math.isnan(capability(estimator)["time_to_full_s"])


def test_values_are_unknown_without_samples_and_without_the_identifier() -> None:
    without = Estimator(TRUTH, initial_soc=0.5, identifier=None)
    without.step(0.0, 0.0, 3.7)
    for estimator in (Estimator(TRUTH, initial_soc=0.5), without):
        assert all(math.isnan(value) for value in capability(estimator).values())
