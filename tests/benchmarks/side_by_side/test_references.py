"""References of the comparison with other methods, computed for a simulated cell with known elements."""

import numpy as np
import pytest

from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SAMPLE
from tests.benchmarks.side_by_side.references import (
    fit_two_exponentials,
    pulse_resistance,
    relaxations,
    settling_time_s,
    with_resistance_step,
)
from tests.benchmarks.side_by_side.trials import Block

CAPACITY_AH = 3.0
R_S, R_TS, TAU_TS, R_TL, TAU_TL = 0.08, 0.02, 20.0, 0.03, 300.0


def elements() -> Floats:
    """Return the coefficients a1..a21 of the thesis for elements that do not depend on SOC."""
    a = np.zeros(22)
    # offsets of the elements (2.5)-(2.9); their amplitudes remain 0
    a[[3, 6, 9, 12, 15]] = R_TS, R_TL, TAU_TS / R_TS, TAU_TL / R_TL, R_S
    # coefficients of the OCV (2.10)
    a[[16, 17, 18, 19]] = 0.5, 20.0, 3.4, 0.7
    return a


def relaxation_test(rest_s: int = 900, resolution_v: float = 1e-3) -> Block:
    """Return seventeen discharges at C/2 for six minutes, each followed by a rest, at 1 Hz and with ``resolution_v``."""
    current_a = np.tile(np.r_[np.full(360, 1.5), np.zeros(rest_s)], 17)
    time_s = np.arange(float(current_a.size))
    voltage_v, soc = simulate_cell((1.0, 0.0, 0.0), time_s, current_a, 3600.0 * CAPACITY_AH, elements())
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    noise_v = 0.5 * resolution_v * np.random.default_rng(1).standard_normal(time_s.size)
    samples["time_s"], samples["current_a"] = time_s, current_a
    samples["voltage_v"] = np.round((voltage_v + noise_v) / resolution_v) * resolution_v
    return Block(samples, soc)


def test_rests_with_noise_give_both_rc_products_within_five_percent():
    result = relaxations(relaxation_test(), CAPACITY_AH)
    assert result.soc.size >= 15
    assert np.median(result.tau_ts_s) == pytest.approx(TAU_TS, rel=0.05)
    assert np.median(result.tau_tl_s) == pytest.approx(TAU_TL, rel=0.05)


def test_rests_without_noise_give_both_rc_products_within_one_percent():
    result = relaxations(relaxation_test(resolution_v=1e-7), CAPACITY_AH)
    assert result.soc.size == 17
    assert result.tau_ts_s == pytest.approx(TAU_TS, rel=0.01)
    assert result.tau_tl_s == pytest.approx(TAU_TL, rel=0.01)


def test_a_short_rest_or_a_single_exponential_gives_no_time_constants():
    assert relaxations(relaxation_test(rest_s=500), CAPACITY_AH).soc.size == 0
    time_s = np.arange(1.0, 900.0)
    assert fit_two_exponentials(time_s, 3.7 - 0.02 * np.exp(-time_s / 100.0)) is None


def test_pulses_give_the_series_resistance_within_two_percent():
    result = pulse_resistance(relaxation_test(), CAPACITY_AH)
    assert result.ohm.size >= 30
    # At 1 Hz a pulse also contains the first second of both RC pairs.
    expected_ohm = R_S + R_TS * (1.0 - np.exp(-1.0 / TAU_TS)) + R_TL * (1.0 - np.exp(-1.0 / TAU_TL))
    assert np.median(result.ohm) == pytest.approx(expected_ohm, rel=0.02)


def test_pulses_give_the_series_resistance_although_the_voltage_is_logged_one_row_late():
    time_s, current_a = [], []
    for n in range(12):  # at 1 Hz in rests and 10 Hz in pulses, as an HPPC is logged
        rest_s, pulse_s = np.arange(0.0, 600.0), np.arange(600.0, 610.0, 0.1)
        time_s.append(620.0 * n + np.r_[rest_s, pulse_s, pulse_s + 10.0])
        current_a.append(np.r_[np.zeros(600), np.full(100, 3.0), np.zeros(100)])
    time_s, current_a = np.concatenate(time_s), np.concatenate(current_a)
    voltage_v, soc = simulate_cell((1.0, 0.0, 0.0), time_s, current_a, 3600.0 * CAPACITY_AH, elements())
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = time_s, current_a
    samples["voltage_v"] = np.r_[voltage_v[0], voltage_v[:-1]]
    result = pulse_resistance(Block(samples, soc), CAPACITY_AH)
    assert result.ohm.size >= 20
    assert result.ohm == pytest.approx(R_S, rel=0.02)


def test_a_step_of_the_resistance_appears_in_later_pulses_only():
    block = relaxation_test()
    with_step, jump_s = with_resistance_step(block, more_ohm=0.04)
    before, after = (pulse_resistance(b, CAPACITY_AH) for b in (block, with_step))
    after_step = before.time_s > jump_s + 6000.0  # all nine pulses of the median are after the step
    assert after_step.sum() >= 5
    assert (after.ohm - before.ohm)[after_step] == pytest.approx(0.04, rel=0.05)
    before_step = before.time_s < jump_s - 6000.0
    assert before_step.sum() >= 5
    assert np.array_equal(after.ohm[before_step], before.ohm[before_step])


def test_the_settling_time_ends_when_the_value_stays_within_ten_percent():
    time_s = np.arange(0.0, 4000.0, 10.0)
    ratio = np.where(time_s < 1000.0, 1.0, 1.0 - 0.5 * np.exp(-(time_s - 1000.0) / 200.0))
    settled_s = settling_time_s(time_s, ratio, 1000.0)
    assert settled_s == pytest.approx(200.0 * np.log(5.0), abs=10.0)
    ratio[250] = 2.0  # a deviation at 2500 s, long after the value has settled
    assert settling_time_s(time_s, ratio, 1000.0) == settled_s
    assert settling_time_s(time_s, np.where(time_s < 1000.0, 1.0, 0.5), 1000.0) == np.inf
    assert settling_time_s(time_s, np.where(time_s < 1000.0, 2.0, 1.0), 1000.0) is None
