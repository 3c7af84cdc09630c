"""Step 3 of the thesis's procedure for a known cell: R_s in SOC bins by (4.2), and the fit of a13..a15 by (2.9)."""

import numpy as np
import pytest

from bms_estimator.calibration.thesis.prediction import predict
from bms_estimator.calibration.thesis.series_resistance import (
    SeriesResistance,
    fit_series_resistance,
    mean_of,
    series_resistance,
)
from bms_estimator.kernels.cell_model.chen_mora import r_s
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis.simulation import discharge
from tests.calibration.simulated_load import TRUTH, capture, constant, steps

CELL = load_cell("chen_mora")
CURRENTS_A = (0.1, 0.275, 0.55)
SOC = np.linspace(0.05, 0.99, 200)


def true_ohm(soc, cell=CELL):
    """Return the true R_s at each SOC [ohm]."""
    return np.array([r_s(x, cell.a) for x in soc])


def r_s_of_load(current_a, noise_v=0.0):
    """Return R_s by (4.2) from one constant load with the true RC pairs."""
    samples = discharge(CELL, current_a, 1.0)
    samples["voltage_v"] += noise_v * np.random.default_rng(1).standard_normal(samples.size)
    return series_resistance(CELL, predict(CELL, samples, 1.0, lowest_soc=0.02))


@pytest.fixture(scope="module")
def r_s_of_loads():
    """Return R_s by (4.2) from each of three constant loads, with 0.5 mV of noise."""
    return [r_s_of_load(current_a, noise_v=0.5e-3) for current_a in CURRENTS_A]


def test_equation_4_2_gives_the_true_resistance_at_every_current():
    for current_a in CURRENTS_A:
        result = r_s_of_load(current_a)
        assert result.soc.size > 95
        inside = result.soc > 0.05
        assert result.r_s_ohm[inside] == pytest.approx(true_ohm(result.soc)[inside], rel=0.01)


def test_fit_to_several_noisy_currents_is_within_2_percent(r_s_of_loads):
    fit = fit_series_resistance(mean_of(r_s_of_loads), 0.05)
    assert fit(SOC) == pytest.approx(true_ohm(SOC), rel=0.02)
    assert fit.a == pytest.approx(CELL.a[13:16], rel=0.05)
    assert np.isfinite(fit.std).all()
    assert fit.std[2] < 0.01 * fit.a[2]
    assert fit.rms_ohm < 1e-3
    assert fit.element.a == pytest.approx(tuple(fit.a))


def test_steps_with_rests_give_the_series_resistance():
    """The samples at 1 Hz have 0.5 mV of noise. Only samples under load contribute."""
    samples = capture(steps(3), soc=0.98)
    run = predict(TRUTH, samples, 0.98, lowest_soc=0.05)
    result = series_resistance(TRUTH, run)
    assert result.r_s_ohm == pytest.approx(true_ohm(result.soc, TRUTH), rel=0.03)  # some bins have few samples
    fit = fit_series_resistance(result)
    soc = np.linspace(result.soc.min(), 0.95, 50)
    assert fit(soc) == pytest.approx(true_ohm(soc, TRUTH), rel=0.02)


def test_mean_over_currents_is_weighted_by_the_squared_current():
    # SOC, R_s [ohm], and mean squared current [A^2].
    first = SeriesResistance(np.array([0.205, 0.305, 0.405]), np.full(3, 1.0), np.full(3, 3.0))
    second = SeriesResistance(np.array([0.305, 0.405, 0.505]), np.full(3, 3.0), np.full(3, 1.0))
    mean_curve = mean_of([first, second])
    assert mean_curve.soc == pytest.approx([0.205, 0.305, 0.405, 0.505])
    assert mean_curve.r_s_ohm == pytest.approx([1.0, 1.5, 1.5, 3.0])
    assert mean_curve.weight == pytest.approx([3.0, 4.0, 4.0, 1.0])


def test_an_ocv_error_affects_r_s_less_at_a_large_current():
    """An OCV error of 10 mV is 65 mohm of R_s at C/20 of a cell of 3 Ah (erratum 19 of the thesis).

    In the mean of this load and a load of 1.5 A, each R_s is weighted by the square of the current.
    """
    cell = TRUTH.model_copy(
        update={"ocv": TRUTH.ocv.model_copy(update={"ocv_v": tuple(v + 0.01 for v in TRUTH.ocv.ocv_v)})}
    )
    runs = [
        predict(TRUTH, capture(constant(load_a, seconds), soc=0.9, noise_v=0.0), 0.9, lowest_soc=0.3)
        for load_a, seconds in ((0.153, 40_000), (1.5, 5_000))
    ]
    slow, fast = (series_resistance(cell, run) for run in runs)
    slow_error_ohm, fast_error_ohm = (result.r_s_ohm - true_ohm(result.soc, TRUTH) for result in (slow, fast))
    assert np.median(slow_error_ohm) == pytest.approx(0.01 / 0.153, rel=0.01)
    assert np.median(fast_error_ohm) == pytest.approx(0.01 / 1.5, rel=0.01)
    mean_curve = mean_of([slow, fast])
    expected = (0.153 * 0.01 + 1.5 * 0.01) / (0.153**2 + 1.5**2)
    assert np.median(mean_curve.r_s_ohm - true_ohm(mean_curve.soc, TRUTH)) == pytest.approx(expected, rel=0.01)


def test_errors_of_the_rc_pairs_become_part_of_r_s():
    """Under a slow load only the sum of the resistances is determined, as in Table 6 of the thesis."""
    a = np.array(CELL.a)
    a[3] += 0.02  # R_ts too high by 20 mohm
    samples = discharge(CELL, 0.1, 1.0)
    result = series_resistance(CELL, predict(CELL, samples, 1.0, a=a, lowest_soc=0.1))
    settled = (result.soc > 0.2) & (result.soc < 0.9)
    assert result.r_s_ohm[settled] == pytest.approx(true_ohm(result.soc)[settled] - 0.02, abs=5e-4)


def test_a_constant_resistance_has_no_amplitude_over_the_soc():
    soc = np.linspace(0.05, 0.95, 60)
    fit = fit_series_resistance(SeriesResistance(soc, np.full(60, 0.08), np.ones(60)))
    assert fit(soc) == pytest.approx(np.full(60, 0.08), rel=1e-6)
    assert fit.a[0] == pytest.approx(0.0, abs=1e-6)
    assert fit.element.amplitude_ohm > 0.0


def test_no_current_and_too_small_a_soc_range_are_rejected_with_their_numbers():
    resting = capture(np.full(600, 0.001))
    with pytest.raises(UserError, match=r"none above 0\.060 A, the largest is 0\.001 A"):
        series_resistance(TRUTH, predict(TRUTH, resting, 0.98))
    short = capture(constant(1.0, 300))
    with pytest.raises(UserError, match=r"known in 4 steps of SOC, at least 5 are needed"):
        fit_series_resistance(series_resistance(TRUTH, predict(TRUTH, short, 0.98)))
