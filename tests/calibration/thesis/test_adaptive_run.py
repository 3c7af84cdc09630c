"""Adaptation laws of the thesis (schemes 1 to 3 and the improved law), and its Algorithm 1 over a whole discharge.

Numbers in parentheses are equations of the thesis. a1..a12 are the parameters of the RC pairs, a13..a15 those of R_s. k
is the adaptive gain, and e is the error of the voltage that drives both.
"""

import numpy as np
import pytest

from bms_estimator.calibration.thesis.adaptive_run import adaptive_run
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import delta, ocv, r_s
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import Bounds
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis.simulation import discharge, with_bounds
from bms_estimator.settings.observer import SCHEME_2_LAMBDA, IdentifierSettings, ObserverSettings

CELL = load_cell("chen_mora")
SMALL = [1, 3, 6, 13, 15]
"""Indices of the parameters up to the epsilon of scheme 2, which returns them to their initial values."""
LARGE = [i for i in range(1, 16) if i not in SMALL]
DISTURBANCE_V = 0.3
"""Error of the measured voltage, so that e, which drives (3.16), is far from zero [V]."""
DISTURBED_SAMPLES = 500
"""Number of samples with ``DISTURBANCE_V``, which are the first ones."""


def make_settings(law, **others):
    """Return settings of a law as printed: no dead zone, no rearming of k, no loss of lock."""
    printed = {"law": law, "dead_zone_v": 0.0, "rearm_gain": None, "lock_error_v": 100.0}
    return ObserverSettings.model_validate(printed | others)


@pytest.fixture(scope="module")
def disturbed_samples():
    """Return samples of half a minute at 1C and 100 Hz, the first seconds with a voltage error."""
    samples = discharge(CELL, 0.275, 0.01)[:3000]  # current [A], sample period [s]
    samples["voltage_v"][:DISTURBED_SAMPLES] -= DISTURBANCE_V
    return samples


def parameter_change(law, samples, cell=CELL):
    """Return the change of a1..a15 at index 1..15, and that of k, the integral of e^2 over the run (3.13)."""
    estimator = Estimator(cell, make_settings(law), voltage_resolution_v=1e-6, initial_soc=1.0, identifier=None)
    estimator.run(samples)
    change = estimator.state["a"][0] - estimator.settings["a_initial"][0]
    return change, float(estimator.state["k"][0] - estimator.settings["k0"][0])


@pytest.mark.parametrize("every", [1, 10, 100])
def test_scheme_1_changes_every_parameter_by_the_increase_of_k(disturbed_samples, every):
    """(3.16) of the parameters and (3.13) of k both integrate e^2. The samples are at 100, 10 and 1 Hz."""
    change, integral = parameter_change("scheme-1", disturbed_samples[::every])
    assert integral > 1e-3
    assert change[1:] == pytest.approx(np.full(15, integral), rel=1e-6)


def test_scheme_2_returns_small_parameters_to_their_initial_values(disturbed_samples):
    change, integral = parameter_change("scheme-2", disturbed_samples)
    assert change[LARGE] == pytest.approx(np.full(10, integral), rel=1e-6)
    assert np.abs(change[SMALL]).max() < 1e-3 * integral
    while_disturbed, _ = parameter_change("scheme-2", disturbed_samples[:3])
    assert (while_disturbed[SMALL] > 1e-4).all()  # the parameters return afterwards and were not constant
    # e^2 drives both parameters, and the return is negligible after three samples
    assert while_disturbed[1] == pytest.approx(while_disturbed[3], rel=1e-9)


def test_scheme_2_returns_the_parameters_up_to_its_epsilon():
    """``rate`` is the rate at which a parameter returns to its initial value."""
    estimator = Estimator(CELL, make_settings("scheme-2"), initial_soc=1.0, identifier=None)
    assert (estimator.settings["rate"][0, SMALL] == SCHEME_2_LAMBDA).all()
    assert (estimator.settings["rate"][0, LARGE] == 0.0).all()


@pytest.mark.parametrize(("law", "last"), [("scheme-3", 15), ("improved", 12)])
@pytest.mark.parametrize("factor", [0.05, 1.0, 40.0])
def test_bounded_laws_converge_to_their_limits_from_any_initial_value(disturbed_samples, law, last, factor):
    """By (3.18), parameters converge to the limits of Lemma 4.1.3 once the error is gone.

    ``last`` is the index of the last parameter that a law adapts.
    """
    bounds = {
        i: CELL.bounds(i).model_copy(update={"initial": factor * CELL.bounds(i).limit}) for i in range(1, last + 1)
    }
    cell = with_bounds(CELL, bounds)
    estimator = Estimator(cell, make_settings(law), voltage_resolution_v=1e-6, initial_soc=1.0, identifier=None)
    estimator.run(disturbed_samples)
    a = estimator.state["a"][0]
    assert a[1 : last + 1] == pytest.approx([bounds[i].limit for i in range(1, last + 1)], rel=1e-4)
    assert a[last + 1 : 16] == pytest.approx(CELL.a[last + 1 : 16], rel=1e-15)  # a13..a15 come from (4.2)


def test_scheme_3_converges_to_the_limits_of_table_4(disturbed_samples):
    table_4 = {1: (0.30, 0.25), 3: (0.045, 0.03), 6: (0.05, 0.04), 13: (0.15, 0.1), 15: (0.07, 0.04)}
    bounds = {i: Bounds(upper=u, lower=low, weight_upper=100.0, weight_lower=1.0) for i, (u, low) in table_4.items()}
    estimator = Estimator(
        with_bounds(CELL, bounds),
        make_settings("scheme-3"),
        voltage_resolution_v=1e-6,
        initial_soc=1.0,
        identifier=None,
    )
    estimator.run(disturbed_samples)
    limits = [0.2995050, 0.0448515, 0.0499010, 0.1495050, 0.0697030]
    assert estimator.state["a"][0, SMALL] == pytest.approx(limits, rel=1e-4)


@pytest.mark.parametrize("law", ["scheme-1", "scheme-2", "scheme-3", "improved"])
def test_the_estimated_voltage_satisfies_the_output_equation_of_each_law(law):
    """The schemes solve (3.14) together with u = -N e, because y^ depends on u. The improved law uses (4.1)."""
    samples = discharge(CELL, 0.275, 0.01)[:40]
    samples["voltage_v"] -= 0.1
    estimator = Estimator(CELL, make_settings(law, k0=0.3), voltage_resolution_v=1e-6, initial_soc=1.0, identifier=None)
    for time_s, current_a, voltage_v, *_ in samples.tolist():
        state = estimator.state[0].copy()
        estimator.step(time_s, current_a, voltage_v)
    now = estimator.state[0]
    drop_free_v = ocv(now["soc"], *ocv_grid(CELL)) - now["v_ts"] - now["v_tl"]  # (4.1)
    e = voltage_v - now["voltage_estimate_v"]  # (3.15)
    assert abs(e) > 1e-5
    ohm = 0.0 if law == "improved" else r_s(now["soc"], state["a"])
    u = -state["gain"] * e
    assert now["voltage_estimate_v"] == pytest.approx(drop_free_v - u * ohm, abs=1e-9)  # (3.14)


@pytest.fixture(scope="module")
def converged():
    """Return the run of Algorithm 1 over a discharge at C/10 and 1 Hz."""
    samples = discharge(CELL, 0.0275, 1.0)
    estimator = Estimator(
        CELL, make_settings("improved", epsilon_v=1e-3), voltage_resolution_v=1e-6, initial_soc=1.0, identifier=None
    )
    return adaptive_run(estimator, samples)


def test_algorithm_1_converges_and_stops_at_the_stability_conditions(converged):
    """The conditions are violated at the SOCs delta1 and delta2, at which the capacitances C_ts and C_tl are zero."""
    run = converged
    assert run.outcome == "converged"
    assert run.average[1:13] == pytest.approx([CELL.bounds(i).limit for i in range(1, 13)], rel=1e-3)
    a = run.average
    expected = [delta(a[8], a[9], a[7]), delta(a[11], a[12], a[10])]
    assert [crossing.parameter for crossing in run.crossings] == ["a8", "a11"]
    assert [crossing.soc for crossing in run.crossings] == pytest.approx(expected, rel=1e-3)
    for crossing in run.crossings:
        assert crossing.time_s == pytest.approx((1.0 - crossing.soc) * 36_000.0, abs=30.0)
    assert run.window.t_unst_s <= run.crossings[1].time_s
    stopped = run.soc < run.crossings[1].soc
    assert stopped.any()
    assert np.ptp(run.a[stopped], axis=0).max() == 0.0


def test_a8_and_a11_cross_their_stability_conditions_at_the_reported_socs(converged):
    """Figure 19 of the thesis plots both parameters with their conditions."""
    run = converged
    for crossing in run.crossings:
        above = run.soc > 1.02 * crossing.soc
        below = run.soc < 0.98 * crossing.soc
        i = int(crossing.parameter[1:])
        parameter, offset, amplitude = run.a[:, i], run.a[:, i + 1], run.a[:, i - 1]
        settled = above & (run.time_s > 60.0)
        condition = -np.log(offset / amplitude) / np.maximum(
            run.soc, 1e-6
        )  # right side of the condition in Lemma 4.1.1
        assert (parameter[settled] > condition[settled]).all()
        assert (parameter[below] < condition[below]).all()


def test_algorithm_1_reports_why_it_did_not_converge():
    samples = discharge(CELL, 0.0275, 10.0)
    noisy = samples.copy()
    noisy["voltage_v"] += 0.02 * np.random.default_rng(3).standard_normal(noisy.size)

    def outcome(block, **others):
        estimator = Estimator(
            CELL, make_settings("improved", **others), voltage_resolution_v=1e-6, initial_soc=1.0, identifier=None
        )
        return adaptive_run(estimator, block).outcome

    assert outcome(noisy, epsilon_v=1e-3).startswith("not converged: the error never settles within 1.00 mV")
    assert outcome(noisy[:2], epsilon_v=1e-3).startswith("not converged")
    assert outcome(noisy, epsilon_v=0.2) == "converged"


def test_the_error_of_a_run_is_that_of_the_observer_also_with_the_identifier():
    # Fewer samples than FIRST_SAMPLES of ``adaptive_run``, so that each is a snapshot.
    samples = discharge(CELL, 0.055, 1.0)[:150]
    for_adaptive_run, for_plain_run = (
        Estimator(CELL, make_settings("improved"), identifier=IdentifierSettings(), initial_soc=0.9) for _ in range(2)
    )
    trace = for_plain_run.run(samples)
    assert np.abs(trace["tracking_error_v"] - trace["innovation_v"]).max() > 1e-3
    assert adaptive_run(for_adaptive_run, samples).error_v.tolist() == trace["tracking_error_v"].tolist()  # (3.15)


def test_a_capture_outside_the_limits_is_rejected():
    samples = discharge(CELL, 0.0275, 100.0)
    samples["voltage_v"] = 0.0
    with pytest.raises(UserError, match=f"none of {samples.size} samples is within the cell's limits"):
        adaptive_run(Estimator(CELL, initial_soc=1.0, identifier=None), samples)
