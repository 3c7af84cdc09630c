"""R_s by equation (4.2) of the thesis, computed while samples arrive."""

import numpy as np
import pytest

from bms_estimator.calibration.thesis.adapt import CaptureWithSoc, steps_2_and_3
from bms_estimator.calibration.thesis.prediction import predict
from bms_estimator.calibration.thesis.series_resistance import (
    LOWEST_SOC,
    fit_series_resistance,
    series_resistance,
    series_resistance_from_sums,
)
from bms_estimator.checkpoint.identity import without_observer
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.kernels.observer.series_resistance import BINS, MAX_SAMPLES
from bms_estimator.model.arrays import SampleBlock, fields
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.telemetry.parameters import make_parameters_payload
from tests.calibration.simulated_load import TRUTH, capture, steps
from tests.estimator.simulated_cell import run_divided

FIRST_SOC = 0.98
CURRENT_A = 0.06
"""Current above which a sample counts for R_s [A]."""
MIN_BIN_SAMPLES = 100
"""Minimum number of samples of an SOC bin for a comparison.

In bins with fewer, one sample of the adjacent bin matters.
"""
R_S_ERROR = 0.002
"""Relative tolerance of R_s between the live estimate and the command `adapt`. The measured difference is 0.0008.

The live estimate uses the present parameters a1..a12 of the RC pairs, but `adapt` uses their mean, (3.19) of the
thesis. In addition, the live SOC is counted with the mean current of two samples.
"""


def make_thesis_estimator() -> Estimator:
    """Return an estimator with the improved law and without the identifier."""
    return Estimator(
        TRUTH,
        ObserverSettings(law="improved"),
        identifier=None,
        voltage_resolution_v=1e-3,
        initial_soc=FIRST_SOC,
    )


@pytest.fixture(scope="module")
def load() -> SampleBlock:
    """Return samples of five hours of random steps with rests, from rest, at 1 Hz."""
    samples: SampleBlock = capture(steps(3), soc=FIRST_SOC)  # type: ignore[no-untyped-call]
    return samples


def test_live_r_s_equals_r_s_of_the_thesis_procedure_on_the_same_samples(load: SampleBlock) -> None:
    estimator = make_thesis_estimator()
    estimator.run(load)
    offline = steps_2_and_3(TRUTH, [CaptureWithSoc(load, FIRST_SOC)], LOWEST_SOC)
    run = predict(TRUTH, load, FIRST_SOC, a=offline.run.average, lowest_soc=LOWEST_SOC)
    expected, live = series_resistance(TRUTH, run), series_resistance_from_sums(estimator.record[0])
    live_ohm_of_bin = dict(zip(np.floor(live.soc * BINS), live.r_s_ohm, strict=True))
    samples_of_bin = np.bincount(np.floor(run.soc * BINS).astype(int), np.abs(run.current_a) > CURRENT_A, BINS)
    pairs = [
        (ohm, live_ohm_of_bin[soc_bin])
        for soc_bin, ohm in zip(np.floor(expected.soc * BINS), expected.r_s_ohm, strict=True)
        if samples_of_bin[int(soc_bin)] >= MIN_BIN_SAMPLES
    ]
    assert len(pairs) > 10
    offline_ohm, live_ohm = np.array(pairs).T
    assert live_ohm == pytest.approx(offline_ohm, rel=R_S_ERROR)
    soc = np.linspace(0.4, 0.95, 50)  # the capture ends at 0.37
    assert fit_series_resistance(live, LOWEST_SOC)(soc) == pytest.approx(offline.r_s(soc), rel=R_S_ERROR)


def test_step_and_run_give_bit_identical_r_s(load: SampleBlock) -> None:
    run_divided(make_thesis_estimator, load[:3000])
    trace = make_thesis_estimator().run(load[:3000])
    first_current = int(np.argmax(np.abs(load["current_a"]) > CURRENT_A))
    assert np.isnan(trace["r_s_ohm"][:first_current]).all()
    assert np.isfinite(trace["r_s_ohm"][-1])


def test_r_s_by_4_2_is_published_and_is_null_until_a_current_flows(load: SampleBlock) -> None:
    estimator = make_thesis_estimator()
    estimator.run(load[:10])
    before = make_parameters_payload(estimator, 0.0).elements["r_s_ohm"]
    assert (before.value, before.valid) == (None, False)
    assert before.reason == "(4.2) needs a current: none above 0.06 A has flowed"
    estimator.run(load[10:600])
    first = make_parameters_payload(estimator, 0.0)
    assert first.elements["r_s_ohm"].value is not None
    assert (first.elements["r_s_ohm"].std, first.a["a15"].source) == (None, "configured")
    estimator.run(load[600:])
    report = make_parameters_payload(estimator, 0.0)
    offline = steps_2_and_3(TRUTH, [CaptureWithSoc(load, FIRST_SOC)], LOWEST_SOC)
    r_s, a15 = report.elements["r_s_ohm"], report.a["a15"]
    assert r_s.value == pytest.approx(float(offline.r_s(np.array(report.soc))), rel=R_S_ERROR)
    assert (r_s.source, a15.source, r_s.valid) == ("identified", "identified", False)
    assert "(4.2)" in (r_s.reason or "")
    assert a15.value == pytest.approx(offline.r_s.a[2], rel=R_S_ERROR)  # a13..a15
    assert r_s.value is not None
    assert r_s.std is not None
    assert 0.0 < r_s.std < R_S_ERROR * r_s.value


def test_a_checkpoint_restores_the_sums_of_r_s(load: SampleBlock) -> None:
    estimator, next_run = make_thesis_estimator(), make_thesis_estimator()
    estimator.run(load[:5000])
    saved = {name: field.copy() for name, field in fields(estimator.record)}
    assert restore_state(next_run, saved, 5.0) == ""
    sums = ("samples", "square_a2", "product_va", "v_ts", "v_tl")
    for name in sums:
        assert next_run.record["series_resistance"][name].tobytes() == saved[f"series_resistance.{name}"].tobytes()
    settle_s = float(next_run.settings_record["learning"]["settle_s"][0])
    # The load in the gap is unknown. Until the RC pairs have settled, samples do not count.
    next_run.run(load[5000 : 5000 + int(settle_s) - 10])
    assert next_run.record["series_resistance"]["samples"].tobytes() == saved["series_resistance.samples"].tobytes()
    next_run.run(load[5000 + int(settle_s) - 10 :])
    assert next_run.record["series_resistance"]["samples"].sum() > saved["series_resistance.samples"].sum()


def test_sums_that_are_not_finite_are_not_restored(load: SampleBlock) -> None:
    estimator = make_thesis_estimator()
    estimator.run(load[:5000])
    saved = {name: field.copy() for name, field in fields(estimator.record)}
    assert not any(name.startswith("series_resistance.") for name in without_observer(saved))
    saved["series_resistance.product_va"][0, 5] = np.nan
    assert restore_state(make_thesis_estimator(), saved, 5.0) == "product_va of the series_resistance is not finite"


def test_nothing_is_summed_while_the_rc_voltages_are_unknown(load: SampleBlock) -> None:
    """After a start under load and after a gap, the RC voltages depend on an unmeasured load."""
    under_load = int(np.argmax(np.abs(load["current_a"]) > 0.5))
    estimator = make_thesis_estimator()
    estimator.run(load[under_load : under_load + 10])
    reason = make_parameters_payload(estimator, 0.0).elements["r_s_ohm"].reason
    assert reason == "settling after a start under load or a gap: nothing is learned for another 20 min"
    estimator.run(load[under_load + 10 : under_load + 1000])
    assert not estimator.record["series_resistance"]["samples"].any()
    after_gap = make_thesis_estimator()
    after_gap.run(load[:1000])
    before = after_gap.record["series_resistance"]["samples"].sum()
    after_gap.run(load[1100:2000])
    assert after_gap.record["series_resistance"]["samples"].sum() == before


def test_a_full_bin_halves_the_weight_of_its_old_samples(load: SampleBlock) -> None:
    first_current = 5000 + int(np.argmax(np.abs(load["current_a"][5000:]) > CURRENT_A))
    estimator = make_thesis_estimator()
    estimator.run(load[:first_current])
    sums = estimator.record["series_resistance"]
    current_bin = int(estimator.state["soc"][0] * BINS)
    sums["samples"][0, current_bin] = MAX_SAMPLES
    sums["square_a2"][0, current_bin], sums["product_va"][0, current_bin] = 2e4, 2e3  # an R_s of about 0.1 ohm
    estimator.run(load[first_current : first_current + 1])
    assert sums["samples"][0, current_bin] == MAX_SAMPLES / 2 + 1


def test_with_the_identifier_or_another_law_no_r_s_by_4_2_is_computed(load: SampleBlock) -> None:
    for law, identifier in (("improved", IdentifierSettings()), ("learning", None), ("scheme-3", None)):
        estimator = Estimator(TRUTH, ObserverSettings(law=law), identifier=identifier, initial_soc=FIRST_SOC)
        estimator.run(load[:2000])
        assert not estimator.record["series_resistance"]["samples"].any()
