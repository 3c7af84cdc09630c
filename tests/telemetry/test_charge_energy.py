"""Charge and energy through the terminals: what is counted, in which direction, and what is not."""

from itertools import pairwise

import numpy as np
import pytest

from bms_estimator.kernels.trace import TRACE
from bms_estimator.telemetry.charge_energy import ChargeEnergy, ChargeEnergyMeter

GAP_S = 5.0


def trace(time_s: np.ndarray, current_a: float | np.ndarray, voltage_v: float | np.ndarray = 4.0) -> np.ndarray:
    rows = np.zeros(len(time_s), dtype=TRACE)
    rows["time_s"], rows["current_a"], rows["voltage_v"] = time_s, current_a, voltage_v
    return rows


def after(*blocks: np.ndarray) -> ChargeEnergy:
    meter = ChargeEnergyMeter(ChargeEnergy(), GAP_S)
    for block in blocks:
        meter.add(block)
    return meter.update_totals()


def test_an_hour_out_and_half_an_hour_in_count_each_on_its_own_and_upon_what_was_counted_before() -> None:
    meter = ChargeEnergyMeter(ChargeEnergy(1.0, 2.0, 3.0, 4.0), GAP_S)
    meter.add(trace(np.arange(0.0, 3601.0), 2.0))
    assert meter.update_totals() == pytest.approx((3.0, 2.0, 3.008, 4.0))
    meter.add(trace(np.arange(3601.0, 5401.0), -2.0))
    # the step between the two currents comes to nothing
    assert meter.update_totals() == pytest.approx((3.0, 2.0 + 1799 / 1800, 3.008, 4.0 + 0.004 * 1799 / 1800))


def test_it_is_the_same_in_blocks_of_any_size() -> None:
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.001, 4.0, 3000))
    whole = trace(time_s, rng.normal(3.0, 1.0, time_s.size), rng.uniform(3.0, 4.2, time_s.size))
    current_a, power_w = whole["current_a"], whole["current_a"] * whole["voltage_v"]
    wanted = ChargeEnergy().plus_net(np.trapezoid(current_a, time_s), np.trapezoid(power_w, time_s))
    for size in (1, 7, 1000, time_s.size):
        assert after(*(whole[i : i + size] for i in range(0, time_s.size, size))) == pytest.approx(wanted)


@pytest.mark.parametrize("until_s", [4.9, 5.1, 4000.0, -3.0])
def test_over_a_gap_and_a_clock_that_was_set_back_nothing_is_counted(until_s: float) -> None:
    first = np.arange(0.0, 3.0)
    flow = after(trace(first, 1.0), trace(until_s + 2.0 + first, 1.0))
    assert flow.charge_out_ah == pytest.approx((4.0 + (until_s if 0.0 < until_s <= GAP_S else 0.0)) / 3600.0)


def test_slow_samples_are_no_gaps() -> None:
    """One sample a minute: the first step is indistinguishable from a gap."""
    times_s = 60.0 * np.arange(11.0)
    assert after(trace(times_s, 1.0)).charge_out_ah == pytest.approx(9 / 60)
    one_by_one = after(*(trace(times_s[i : i + 1], 1.0) for i in range(11)))
    assert one_by_one.charge_out_ah == pytest.approx(9 / 60)


def test_noise_about_no_current_hardly_counts() -> None:
    """20 mA of it at 100 Hz, looked at once a second: rectified it would be 8 mAh in an hour, in both directions."""
    rng, meter = np.random.default_rng(2), ChargeEnergyMeter(ChargeEnergy(), GAP_S)
    for second in range(3600):
        meter.add(trace(second + np.arange(100) / 100.0, rng.normal(0.0, 0.02, 100)))
        assert meter.update_totals()
    assert max(*meter.update_totals()[:2]) < 1e-3


def test_it_never_decreases_and_its_difference_is_the_net_charge() -> None:
    rng, meter = np.random.default_rng(3), ChargeEnergyMeter(ChargeEnergy(), GAP_S)
    time_s, current_a = 0.1 * np.arange(5000), np.cumsum(rng.normal(0.0, 0.2, 5000))
    flows = [meter.update_totals()]
    for i in range(0, 5000, 10):
        meter.add(trace(time_s[i : i + 10], current_a[i : i + 10]))
        flows.append(meter.update_totals())
    assert all(b >= a >= 0.0 for before, flow in pairwise(flows) for a, b in zip(before, flow, strict=True))
    last = flows[-1]
    assert last.charge_out_ah - last.charge_in_ah == pytest.approx(np.trapezoid(current_a, time_s) / 3600.0)
