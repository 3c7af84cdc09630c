"""Charge and energy through the terminals: sums for each direction, gaps, slow samples and noise."""

from itertools import pairwise

import numpy as np
import pytest

from bms_estimator.kernels.records import TRACE
from bms_estimator.telemetry.publish_window import ChargeEnergy, ChargeEnergyMeter

GAP_S = 5.0
"""Time between samples above which they have a gap [s]."""


def make_trace(time_s: np.ndarray, current_a: float | np.ndarray, voltage_v: float | np.ndarray = 4.0) -> np.ndarray:
    """Return rows of the estimator's trace with these values."""
    rows = np.zeros(len(time_s), dtype=TRACE)
    rows["time_s"], rows["current_a"], rows["voltage_v"] = time_s, current_a, voltage_v
    return rows


def meter_blocks(*blocks: np.ndarray) -> ChargeEnergy:
    """Return the totals of a new meter after these blocks."""
    meter = ChargeEnergyMeter(ChargeEnergy(), GAP_S)
    for block in blocks:
        meter.add(block)
    return meter.update_totals()


def test_each_direction_is_added_to_its_own_earlier_total() -> None:
    """The pack is discharged for an hour and charged for half an hour, with 2 A at 4 V."""
    earlier = ChargeEnergy(charge_out_ah=1.0, charge_in_ah=2.0, energy_out_kwh=3.0, energy_in_kwh=4.0)
    meter = ChargeEnergyMeter(earlier, GAP_S)
    meter.add(make_trace(np.arange(0.0, 3601.0), 2.0))
    assert meter.update_totals() == pytest.approx((3.0, 2.0, 3.008, 4.0))  # 2 Ah and 8 Wh more
    meter.add(make_trace(np.arange(3601.0, 5401.0), -2.0))
    # By the trapezoidal rule, the second between the two currents has a mean current of 0.
    assert meter.update_totals() == pytest.approx((3.0, 2.0 + 1799 / 1800, 3.008, 4.0 + 0.004 * 1799 / 1800))


def test_totals_do_not_depend_on_the_size_of_blocks() -> None:
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.001, 4.0, 3000))
    whole = make_trace(time_s, rng.normal(3.0, 1.0, time_s.size), rng.uniform(3.0, 4.2, time_s.size))
    current_a, power_w = whole["current_a"], whole["current_a"] * whole["voltage_v"]
    expected = ChargeEnergy().plus_net(np.trapezoid(current_a, time_s), np.trapezoid(power_w, time_s))
    for size in (1, 7, 1000, time_s.size):
        assert meter_blocks(*(whole[i : i + size] for i in range(0, time_s.size, size))) == pytest.approx(expected)


@pytest.mark.parametrize("between_s", [4.9, 5.1, 4000.0, -3.0])
def test_a_gap_and_a_backward_step_of_the_clock_add_nothing(between_s: float) -> None:
    """``between_s`` is the time between two blocks of 2 s, with 1 A."""
    time_s = np.arange(0.0, 3.0)
    totals = meter_blocks(make_trace(time_s, 1.0), make_trace(time_s[-1] + between_s + time_s, 1.0))
    counted_s = between_s if 0.0 < between_s <= GAP_S else 0.0
    assert totals.charge_out_ah == pytest.approx((4.0 + counted_s) / 3600.0)


def test_slow_samples_do_not_count_as_gaps() -> None:
    """There is one sample a minute. The first step cannot be distinguished from a gap and is not counted."""
    times_s = 60.0 * np.arange(11.0)
    assert meter_blocks(make_trace(times_s, 1.0)).charge_out_ah == pytest.approx(9 / 60)
    one_by_one = meter_blocks(*(make_trace(times_s[i : i + 1], 1.0) for i in range(11)))
    assert one_by_one.charge_out_ah == pytest.approx(9 / 60)


def test_noise_around_zero_current_adds_less_than_1_mah_an_hour() -> None:
    """The noise is 20 mA at 100 Hz. If each sample were counted, it would add 8 mAh an hour to both directions."""
    rng, meter = np.random.default_rng(2), ChargeEnergyMeter(ChargeEnergy(), GAP_S)
    for second in range(3600):
        meter.add(make_trace(second + np.arange(100) / 100.0, rng.normal(0.0, 0.02, 100)))
        assert meter.update_totals()
    assert max(meter.update_totals().charge_out_ah, meter.update_totals().charge_in_ah) < 1e-3


def test_totals_never_decrease_and_their_difference_is_the_net_charge() -> None:
    rng, meter = np.random.default_rng(3), ChargeEnergyMeter(ChargeEnergy(), GAP_S)
    time_s, current_a = 0.1 * np.arange(5000), np.cumsum(rng.normal(0.0, 0.2, 5000))
    totals = [meter.update_totals()]
    for i in range(0, 5000, 10):
        meter.add(make_trace(time_s[i : i + 10], current_a[i : i + 10]))
        totals.append(meter.update_totals())
    assert all(b >= a >= 0.0 for before, after in pairwise(totals) for a, b in zip(before, after, strict=True))
    last = totals[-1]
    assert last.charge_out_ah - last.charge_in_ah == pytest.approx(np.trapezoid(current_a, time_s) / 3600.0)
