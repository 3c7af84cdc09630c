"""Means of the parameters a1..a15 over a time window, (3.19) of the thesis.

The window begins at t_int, when errors and parameters have settled. It ends at t_unst, before the model becomes
unstable at a low SOC. Both ends are detected or given.
"""

import numpy as np
import pytest

from bms_estimator.calibration.thesis.adaptive_run import (
    AveragingWindow,
    adaptive_run,
    average_parameters,
    averaging_window,
)
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis.simulation import discharge
from bms_estimator.settings.observer import ObserverSettings

CELL = load_cell("chen_mora")
SETTINGS = ObserverSettings.model_validate({"dead_zone_v": 0.0, "rearm_gain": None, "epsilon_v": 1e-3})
TIME_S = np.arange(0.0, 1000.0)
"""Sample times of ``find_window`` [s]."""


def run_algorithm(samples, **ends):
    """Return the run of Algorithm 1 of the thesis over the samples; ``ends`` are given ends of the window."""
    estimator = Estimator(CELL, SETTINGS, voltage_resolution_v=1e-6, initial_soc=1.0, identifier=None)
    return adaptive_run(estimator, samples, **ends)


def find_window(error_v=None, voltage_v=None, margin=None, a=None, **ends):
    """Return the averaging window of a run of 1000 s.

    By default the error is zero, the voltage falls linearly, and margin and parameters are constant.
    """
    return averaging_window(
        TIME_S,
        np.zeros(TIME_S.size) if error_v is None else error_v,
        np.linspace(4.2, 3.6, TIME_S.size) if voltage_v is None else voltage_v,
        np.ones(TIME_S.size) if margin is None else margin,
        np.ones((TIME_S.size, 16)) if a is None else a,
        1e-3,  # limit of a settled error [V]
        **ends,
    )


@pytest.fixture(scope="module")
def samples():
    """Return samples of a simulated discharge at C/5 and 10 Hz."""
    return discharge(CELL, 0.055, 0.1)


def test_a_simulated_discharge_is_averaged_from_settling_to_instability(samples):
    result = run_algorithm(samples)
    window = result.window
    assert 0.0 < window.t_int_s < 60.0  # a1 to a12 start far from their limits
    assert window.start_reason == "99 % of the later errors are within 1.00 mV"
    assert window.end_reason == "knee of the voltage"
    assert 0.9 * samples["time_s"][-1] < window.t_unst_s < result.crossings[1].time_s
    limits = [CELL.bounds(i).limit for i in range(1, 13)]
    assert result.average[1:13] == pytest.approx(limits, rel=1e-4)


def test_both_ends_can_be_given():
    """By (4.5) of the thesis, the mean from the first sample to t is limit + (a_i(t0) - limit) / (rate t)."""
    result = run_algorithm(discharge(CELL, 0.055, 0.01)[:50_000], t_int_s=0.0, t_unst_s=400.0)
    assert result.window == AveragingWindow(0.0, 400.0, "given", "given")
    for i in (1, 3, 4, 6, 8, 12):
        bounds = CELL.bounds(i)
        expected_deviation = (bounds.initial - bounds.limit) / (bounds.rate * 400.0)
        # The tolerance covers the error of trapezoids at 100 Hz.
        assert result.average[i] - bounds.limit == pytest.approx(expected_deviation, rel=0.15)


def test_a_given_end_does_not_change_the_other_end(samples):
    automatic = run_algorithm(samples).window
    later = run_algorithm(samples, t_int_s=1000.0).window
    assert (later.t_int_s, later.start_reason) == (1000.0, "given")
    assert (later.t_unst_s, later.end_reason) == (automatic.t_unst_s, automatic.end_reason)
    earlier = run_algorithm(samples, t_unst_s=5000.0).window
    assert (earlier.t_unst_s, earlier.end_reason) == (5000.0, "given")
    assert earlier.t_int_s == pytest.approx(automatic.t_int_s, abs=1.0)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ({"t_unst_s": -1.0}, "t_unst = -1 s: must lie within 0 to 999 s of the run"),
        ({"t_unst_s": 2000.0}, "t_unst = 2000 s: must lie within 0 to 999 s of the run"),
        ({"t_int_s": -5.0}, "t_int = -5 s: must lie within 0 to 999 s of the run"),
        ({"t_int_s": float("nan")}, "t_int = nan s: must lie within 0 to 999 s of the run"),
        ({"t_int_s": 500.0, "t_unst_s": 400.0}, "t_int = 500 s: must lie within 0 to 400 s of the run"),
    ],
)
def test_an_end_outside_the_run_is_rejected(ends, message):
    with pytest.raises(UserError, match=message):
        find_window(**ends)


def test_t_int_is_the_time_at_which_the_error_has_settled():
    window = find_window(error_v=np.where(TIME_S < 120.0, 5e-3, 2e-4))
    assert window.t_int_s == pytest.approx(112.0, abs=9.0)  # one sample in a hundred may be beyond the limit
    assert "99 % of the later errors are within 1.00 mV" in window.start_reason
    spikes = np.where((TIME_S < 50.0) | (TIME_S % 300.0 == 299.0), 5e-3, 0.0)
    assert 40.0 <= find_window(error_v=spikes).t_int_s <= 50.0


def test_t_int_is_after_the_settling_of_the_parameters():
    a = np.ones((TIME_S.size, 16))
    a[:, 4] += 10.0 * np.exp(-TIME_S / 20.0)
    window = find_window(a=a)
    assert window.t_int_s == pytest.approx(20.0 * np.log(1e4), abs=1.5)  # within 0.1 % of the median
    assert "every later a_i is within 0.1 % of its median" in window.start_reason


def test_an_error_that_never_settles_leaves_no_window():
    window = find_window(error_v=np.full(TIME_S.size, 0.0123))
    assert window.start_reason == "the error never settles within 1.00 mV"
    assert window.t_int_s == TIME_S[-1]


def test_t_unst_is_the_first_of_stability_limit_voltage_knee_and_end_of_the_run():
    assert (find_window().t_unst_s, find_window().end_reason) == (TIME_S[-1], "end of the run")
    margin = np.where(TIME_S >= 900.0, -1e-3, 0.1)
    assert (find_window(margin=margin).t_unst_s, find_window(margin=margin).end_reason) == (
        900.0,
        "SOC reached max(delta1, delta2)",
    )
    knee = np.linspace(4.2, 3.6, TIME_S.size) - np.maximum(TIME_S - 800.0, 0.0) * 0.01
    window = find_window(voltage_v=knee, margin=margin)
    assert window.end_reason == "knee of the voltage"
    assert window.t_unst_s == pytest.approx(800.0, abs=12.0)
    temporary_load = np.linspace(4.2, 3.6, TIME_S.size) - np.where((TIME_S > 500.0) & (TIME_S < 520.0), 0.3, 0.0)
    assert find_window(voltage_v=temporary_load).end_reason == "end of the run"  # a temporary load is no knee


def test_the_mean_over_uneven_steps_is_weighted_by_time():
    time_s = np.cumsum(np.random.default_rng(1).uniform(0.01, 2.0, 5000))
    a = np.tile(time_s[:, None], (1, 16))  # a_i(t) = t, whose mean is the middle
    times_in_window = time_s[(time_s >= 500.0) & (time_s <= 2000.0)]
    result = average_parameters(time_s, a, AveragingWindow(500.0, 2000.0, "given", "given"))
    assert result == pytest.approx(np.full(16, 0.5 * (times_in_window[0] + times_in_window[-1])), rel=1e-9)


def test_mean_over_an_empty_window_is_the_last_value():
    a = np.tile(TIME_S[:, None], (1, 16))
    assert average_parameters(TIME_S, a, AveragingWindow(5000.0, 6000.0, "given", "given"))[1] == TIME_S[-1]
    assert average_parameters(TIME_S, a, AveragingWindow(10.0, 10.5, "given", "given"))[1] == 10.0
