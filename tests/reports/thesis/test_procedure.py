"""Procedure of chapter 5 of the thesis on captures: use of each capture, requirements, and results.

Step 1 fits the OCV to relaxation tests, step 2 the RC pairs to the constant load with the smallest current, and step 3
R_s to constant loads with small currents and to relaxation tests. Other loads validate the result. It is the dynamic
model; the elements of the static model are those of one SOC.
"""

import re
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.calibration.thesis.adapt import printed_bounds
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.reports.thesis.experiment import CLAIMS, Claim, Experiment, RecordedCaptures, Result, claim
from bms_estimator.reports.thesis.experiment_figures import FIGURES, MAX_LOADS, constant_loads, step_loads
from bms_estimator.reports.thesis.procedure import (
    Capture,
    Kind,
    Procedure,
    kind_of,
)
from bms_estimator.reports.thesis.report_items import Reproduction
from bms_estimator.sources.captures.replay import load_capture
from tests.benchmarks.thesis import chapter5
from tests.calibration.simulated_load import TRUTH, capture, constant, steps
from tests.calibration.simulated_relaxation import relaxation

CAPACITY_AH = TRUTH.cell.capacity_ah
KIND_BY_NAME = {"relaxation": Kind.RELAXATION, "slow": Kind.CONSTANT, "constant": Kind.CONSTANT, "steps": Kind.STEPS}
RESULTS_DOCUMENT = Path(__file__).parents[2] / "benchmarks" / "thesis" / "chapter5_results.md"


@pytest.fixture(scope="module")
def samples():
    """Return captures of ``TRUTH`` by name."""
    return {
        "relaxation": relaxation(),
        "slow": capture(constant(0.5, 24_000), soc=1.0),
        "constant": capture(constant(1.0, 12_000), soc=1.0),
        "steps": capture(steps(2), soc=0.98),
    }


def make_procedure(samples):
    """Return the procedure on captures of ``TRUTH`` with a voltage resolution of 1 mV."""
    captures = [Capture(name, kind_of(name, block, CAPACITY_AH), block) for name, block in samples.items()]
    return Procedure(TRUTH, captures, 1e-3)


@pytest.fixture(scope="module")
def procedure(samples):
    """Return the procedure on all four captures."""
    return make_procedure(samples)


@pytest.fixture(scope="module")
def leaf_procedure(data):
    """Return the procedure on two captures of a Leaf cell: one with rests, and the 1 C discharge of a longer one."""
    hppc, cc = (load_capture(data / "leaf" / f"{name}.csv.gz").rows for name in ("hppc_25c_from_full", "cc_1c"))
    captures = [Capture("hppc", Kind.RELAXATION, hppc), Capture("cc", Kind.CONSTANT, chapter5.discharge(cc, 0.3))]
    return Procedure(load_cell("leaf"), captures, 1e-3)


def test_a_constant_load_beyond_the_number_of_plots_is_not_drawn_as_a_step(samples):
    procedure = make_procedure(samples | {f"constant {i}": samples["constant"] for i in range(MAX_LOADS)})
    assert (len(constant_loads(procedure)), step_loads(procedure)) == (MAX_LOADS, ["steps"])


@pytest.mark.parametrize("noise_a", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("name", KIND_BY_NAME)
def test_the_kind_of_a_capture_is_recognized(samples, name, noise_a):
    block = samples[name].copy()
    block["current_a"] += noise_a * np.random.default_rng(0).standard_normal(block.size)
    assert kind_of(name, block, CAPACITY_AH) is KIND_BY_NAME[name]


def test_the_initial_soc_of_each_capture_is_determined(procedure):
    initial_soc = {c.name: procedure.initial_soc(c) for c in procedure.captures}
    assert (initial_soc["relaxation"], initial_soc["constant"]) == (1.0, 1.0)
    assert initial_soc["steps"] == pytest.approx(0.98, abs=0.01)


def test_the_model_with_frozen_parameters_is_validated_on_other_loads(procedure):
    """The errors in percent are those of (5.3) of the thesis, as in its Table 11.

    Most of the error is due to the OCV of ``TRUTH``, which is not of the form (2.10).
    """
    assert procedure.smallest.name == "slow"
    assert [c.name for c in procedure.validating] == ["constant", "steps"]
    results = {name: (run.mean_percent, run.max_percent) for name, run in procedure.dynamic.items()}
    assert results["constant"] == pytest.approx((0.221, 0.687), abs=0.01)
    assert results["steps"] == pytest.approx((0.224, 1.106), abs=0.01)


def test_the_static_model_is_worse_on_every_load(procedure):
    results = {name: run.mean_percent for name, run in procedure.static.items()}
    assert results == pytest.approx({"slow": 0.331, "constant": 0.477, "steps": 0.262}, abs=0.01)
    assert all(results[name] > run.mean_percent for name, run in procedure.dynamic.items())


def test_the_soc_by_interpolation_of_the_ocv_is_near_the_counted_one(procedure):
    soc, ocv_v = procedure.interpolate_soc("constant")
    counted_soc = procedure.dynamic["constant"].soc
    assert 100.0 * np.sqrt(np.mean((soc - counted_soc) ** 2)) == pytest.approx(1.15, abs=0.05)
    assert ocv_v.shape == soc.shape


@pytest.mark.parametrize("name", ["constant", "steps"])
def test_a_validating_capture_changes_no_parameter(samples, name):
    """A voltage error of 50 mV in the capture does not change any of a1..a21."""
    with_voltage_error = samples[name].copy()
    with_voltage_error["voltage_v"][100:] += 0.05  # the first rest still gives the initial SOC
    before, after = make_procedure(samples), make_procedure(samples | {name: with_voltage_error})
    assert after.a_for(name).tolist() == before.a_for(name).tolist()
    assert after.joint_fit.a.tolist() == before.joint_fit.a.tolist()
    assert after.dynamic[name].mean_percent > before.dynamic[name].mean_percent + 0.5


def test_captures_of_step_3_change_the_parameters(samples):
    with_voltage_error = samples["constant"].copy()
    with_voltage_error["voltage_v"] += 0.05
    before, after = make_procedure(samples), make_procedure(samples | {"constant": with_voltage_error})
    assert after.a_for("steps")[15] < before.a_for("steps")[15] - 0.005


def test_a_load_above_the_c_rates_of_the_thesis_is_used_only_for_validation(samples):
    with_fast_load = make_procedure(samples | {"constant": capture(constant(2.0, 6_000), soc=1.0)})
    assert list(with_fast_load.r_s_curves) == ["slow", "relaxation"]
    assert [c.name for c in with_fast_load.validating] == ["constant", "steps"]


def test_validation_ends_at_the_lowest_soc_of_all_relaxation_tests(samples, procedure):
    """A second test that ends half full does not raise the end of validation."""
    half_test = samples["relaxation"][: samples["relaxation"].size // 2]
    with_both_tests, with_half_test = (
        make_procedure(samples | {"half": half_test}),
        make_procedure(samples | {"relaxation": half_test}),
    )
    assert [test.name for test in with_both_tests.tests] == ["relaxation", "half"]
    assert with_both_tests.lowest_soc == procedure.lowest_soc < 0.1
    assert with_half_test.lowest_soc == with_both_tests.tests[1].soc.min() > 0.4
    assert with_both_tests.dynamic["constant"].soc[-1] == pytest.approx(procedure.lowest_soc, abs=1e-3)
    assert with_both_tests.r_s_mean.soc.min() == pytest.approx(procedure.lowest_soc, abs=0.02)


def test_printed_bounds_are_scaled_by_cells_and_capacity():
    pack = load_cell("thunder_power_6s")
    assert printed_bounds(pack) == {name: pack.adaptation[name] for name in pack.adaptation}
    scaled = printed_bounds(TRUTH)
    ohm_factor = 6.6 / 3.0 / 6.0  # a cell of 3 Ah, and a pack of 6.6 Ah with six cells in series
    assert scaled["a3"].limit == pytest.approx(ohm_factor * pack.bounds(3).limit)  # a resistance
    assert scaled["a9"].limit == pytest.approx(pack.bounds(9).limit / ohm_factor)  # a capacitance
    assert scaled["a5"] == pack.adaptation["a5"]  # an exponent
    with_own_bound = TRUTH.model_copy(update={"adaptation": {"a3": pack.adaptation["a3"]}})
    captures = [Capture(name, kind, np.empty(0)) for name, kind in KIND_BY_NAME.items()]
    # Bounds of the cell file take precedence.
    assert Procedure(with_own_bound, captures, 1e-3).cell.bounds(3) == pack.adaptation["a3"]


@pytest.mark.parametrize(
    ("missing", "expected_text"),
    [(("relaxation",), "voltage relaxation test"), (("slow", "constant", "steps"), "constant load or steps")],
)
def test_missing_captures_are_reported(samples, missing, expected_text):
    captures = [Capture(name, KIND_BY_NAME[name], block) for name, block in samples.items() if name not in missing]
    with pytest.raises(UserError, match=rf"needs a {expected_text}; given: .*\)"):
        Procedure(TRUTH, captures, 1e-3)


def test_a_single_constant_load_validates_and_step_2_uses_the_relaxation_test(leaf_procedure):
    assert leaf_procedure.smallest.name == "hppc"
    assert [c.name for c in leaf_procedure.validating] == ["cc"]


@pytest.mark.parametrize(("remaining", "missing"), [("steps", ("33", "34")), ("constant", ("36", "37", "38"))])
def test_the_figure_of_a_missing_load_is_empty_with_a_reason(samples, remaining, missing):
    recorded = RecordedCaptures(TRUTH, tuple((name, samples[name]) for name in ("relaxation", remaining)), 1e-3)
    experiment = Experiment(recorded)
    figures = {key: FIGURES[key](experiment) for key in ("33", "34", "36", "37", "38")}
    assert {key for key, figure in figures.items() if not figure.svg} == set(missing)
    assert all(
        "None of the captures is such a load." in figures[key].reason for key in missing if key not in ("34", "36")
    )
    assert not any("None of the captures" in figure.reason for key, figure in figures.items() if key not in missing)


def test_errors_of_the_leaf_cell_are_those_of_the_document(leaf_procedure):
    """The document is docs/theory/thesis.md."""
    run, (soc, _) = leaf_procedure.dynamic["cc"], leaf_procedure.interpolate_soc("cc")
    assert (run.mean_percent, run.max_percent) == pytest.approx((0.543, 2.37), abs=0.005)
    assert leaf_procedure.static["cc"].mean_percent == pytest.approx(0.517, abs=0.005)
    assert 100.0 * np.sqrt(np.mean((soc - run.soc) ** 2)) == pytest.approx(2.7, abs=0.05)
    assert 1e3 * np.sqrt(np.mean(leaf_procedure.joint_fit.residual_v**2)) == pytest.approx(5.8, abs=0.05)


def test_the_claims_of_the_thesis_have_these_verdicts_on_the_leaf_cell(leaf_procedure):
    verdicts = [claim(key, [leaf_procedure]).verdict for key in CLAIMS]
    fails, holds, no_data = Reproduction.CLAIM_FAILS, Reproduction.CLAIM_HOLDS, Reproduction.NO_DATA
    assert verdicts == [fails, fails, no_data, no_data, fails, fails, holds, fails]


def test_captures_of_the_same_name_of_two_cells_count_twice(leaf_procedure):
    once, twice = claim("RC products", [leaf_procedure]), claim("RC products", [leaf_procedure, leaf_procedure])
    assert twice.results == 2 * once.results
    assert len(once.results) == 2


def test_the_claims_on_dynamic_against_static_compare_the_ratio_of_mean_errors(leaf_procedure):
    """0.543 and 0.517 % are the mean errors of both models; 0.003 and 0.358 % are those printed in the thesis."""
    for key, limit in (("order", 1.0), ("ratio", 0.003 / 0.358)):
        (result,) = claim(f"dynamic against static, {key}", [leaf_procedure]).results
        assert (result.value, result.limit) == (pytest.approx(0.543 / 0.517, abs=0.01), limit)
        assert not result.is_met


@pytest.mark.parametrize(
    ("met", "verdict"), [(0, Reproduction.CLAIM_FAILS), (2, Reproduction.CLAIM_FAILS), (3, Reproduction.CLAIM_HOLDS)]
)
def test_a_claim_holds_if_it_is_met_on_more_than_half_of_the_captures(met, verdict):
    results = tuple(Result(f"load {i}", 1.0 if i < met else 2.0, 1.5) for i in range(4))
    claim_result = Claim("mean", "Table 11", "mean error at most 1.5 %", results)
    assert (claim_result.captures_met, claim_result.verdict) == (met, verdict)
    assert claim_result.span == {0: "2", 2: "1 to 2", 3: "1 to 2"}[met]
    assert f"met on {met} of 4 captures (values {claim_result.span})" in claim_result.sentence


@pytest.fixture(scope="module")
def real_cell_procedures(shared_data):
    """Return the procedure on each experiment with a real cell, by name."""
    return {experiment.name: chapter5.make_procedure(experiment) for experiment in chapter5.EXPERIMENTS}


@pytest.mark.thorough
def test_the_results_document_lists_every_measured_error(real_cell_procedures):
    """The values of the document agree in all printed digits."""
    measured = [" | ".join(row) for name, p in real_cell_procedures.items() for row in chapter5.load_rows(name, p)]
    table = RESULTS_DOCUMENT.read_text(encoding="utf-8").split("## Errors")[1].split("\n## ")[0]
    assert re.findall(r"^\| (.*) \|$", table, re.MULTILINE)[1:] == measured


@pytest.mark.thorough
def test_the_results_document_lists_every_verdict(real_cell_procedures):
    at_room = [real_cell_procedures[experiment.name] for experiment in chapter5.EXPERIMENTS if experiment.room]
    measured = [
        " | ".join((key, *outcome, *outcome_at_room))
        for (key, *outcome), (_, *outcome_at_room) in zip(
            chapter5.outcomes(list(real_cell_procedures.values())), chapter5.outcomes(at_room), strict=True
        )
    ]
    table = RESULTS_DOCUMENT.read_text(encoding="utf-8").split("## Verdicts")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (.*) \|$", table, re.MULTILINE)
    first = rows.index(measured[0])
    assert rows[first : first + len(CLAIMS)] == measured
    assert rows[-len(chapter5.STEP_3_VARIANTS) :] == [
        " | ".join(row) for row in chapter5.steps_met(real_cell_procedures)
    ]
