"""Benchmark of forecasts: its scores by hand, the cut-off of a capture, and a run on one capture."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.arrays import SAMPLE, SampleBlock
from tests.benchmarks.forecast.__main__ import main
from tests.benchmarks.forecast.scores import INTERVAL_S, Outcome, Quantiles, lead, said_between, score
from tests.benchmarks.forecast.truth import discharge_of

DATA = Path(__file__).parents[2] / "data"
OUTCOME = Outcome("capture", "file", "drive", False, 25.0, True, 0.5, 1000.0, Quantiles(800.0, 1100.0, 1300.0))


def samples(time_s: list[float], current_a: list[float], voltage_v: list[float]) -> SampleBlock:
    """Return samples without temperature."""
    made = np.zeros(len(time_s), SAMPLE)
    made["time_s"], made["current_a"], made["voltage_v"], made["temperature_c"] = time_s, current_a, voltage_v, math.nan
    return made


def test_interval_score_is_the_width_while_the_truth_is_inside_the_band():
    scores = score([OUTCOME])
    assert scores is not None
    assert (scores.count, scores.inside, scores.early) == (1, 1.0, 0.0)
    assert scores.error == pytest.approx(0.1)
    assert scores.interval == scores.mean_interval == pytest.approx(0.5)


@pytest.mark.parametrize(("truth_s", "early"), [(700.0, 1.0), (1400.0, 0.0)])
def test_interval_score_adds_twenty_times_the_distance_outside_the_band(truth_s, early):
    scores = score([replace(OUTCOME, truth_s=truth_s)])
    assert scores is not None
    assert (scores.inside, scores.early) == (0.0, early)
    assert scores.interval == pytest.approx((500.0 + 20.0 * 100.0) / truth_s)


def test_shares_count_each_forecast_once():
    scores = score([replace(OUTCOME, truth_s=t) for t in (700.0, 900.0, 1000.0, 1400.0)])
    assert scores is not None
    assert (scores.count, scores.inside, scores.early) == (4, 0.5, 0.25)


def test_pinball_loss_weights_each_side_of_a_quantile_by_its_level():
    e = math.e
    scores = score([replace(OUTCOME, truth_s=100.0, said=Quantiles(100.0 / e, 100.0, 100.0 * e))])
    assert scores is not None
    assert scores.pinball == pytest.approx((0.05 + 0.0 + 0.05) / 3.0)


def test_no_outcomes_have_no_score():
    assert score([]) is None


def test_horizon_is_that_of_the_median_and_lead_that_of_the_capture():
    assert said_between(10.0, 20.0)(OUTCOME)
    assert not said_between(20.0, 40.0)(OUTCOME)
    assert lead(600.0, 1000.0)(OUTCOME)
    assert not lead(1200.0)(OUTCOME)


def test_discharge_ends_at_the_first_sample_at_the_cutoff_voltage():
    rows = samples([0.0, 1000.0, 2000.0, 3000.0], [1.0, 1.0, 1.0, 0.0], [4.0, 3.0, 2.6, 2.5])
    found = discharge_of(rows, 2.6, 1.0)
    assert found is not None
    assert (found.end_s, found.cutoff_v) == (2000.0, 2.6)


def test_cutoff_is_the_lowest_voltage_of_a_capture_that_ends_above_it():
    rows = samples([0.0, 1000.0, 2000.0, 3000.0], [1.0, 1.0, 1.0, 0.0], [4.0, 3.5, 3.0, 3.2])
    found = discharge_of(rows, 2.6, 1.0)
    assert found is not None
    assert (found.end_s, found.cutoff_v) == (2000.0, 3.0)


def test_short_capture_is_no_discharge():
    assert discharge_of(samples([0.0, 800.0], [9.0, 9.0], [4.0, 2.5]), 2.6, 1.0) is None


def test_charge_is_no_discharge():
    assert discharge_of(samples([0.0, 5000.0], [-1.0, -1.0], [2.5, 4.0]), 2.6, 1.0) is None


OPTIONS = ["leaf/cc_1c", "--data", str(DATA), "--cell", "leaf", "--capacity-ah", "30.5"]
"""Options for a capture that is part of this repository."""


def test_tool_judges_a_real_capture_minute_by_minute(capsys):
    main([*OPTIONS, "--json"])
    forecasts = json.loads(capsys.readouterr().out)
    assert [o["truth_s"] for o in forecasts[-10:]] == pytest.approx(
        [60.0 * n for n in range(10, 0, -1)], abs=0.5 * INTERVAL_S
    )
    assert all(o["said"][0] <= o["said"][1] <= o["said"][2] for o in forecasts)


def test_capture_of_an_unknown_cell_asks_for_a_cell_file(tmp_path):
    (tmp_path / "unknown").mkdir()
    (tmp_path / "unknown" / "drive.csv.gz").touch()
    with pytest.raises(SystemExit, match="give one with --cell"):
        main(["--data", str(tmp_path)])
