"""A pack identified anew from what it has sent: better than before, or why not."""

import numpy as np
import pytest

from bms_estimator.fleet.identification.reidentify import reidentify
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_file import cell_text
from bms_estimator.model.config_file import parse_toml
from tests.calibration.simulated_load import TRUTH, capture, wrong_start

SERIES, PARALLEL = 14, 4
KIND = PackSpec(
    cell="own", series=SERIES, parallel=PARALLEL, voltage_resolution_v=0.01, current_resolution_a=0.01, period_s=5.0
)
WRONG = cell_text(wrong_start(1.3, 0.8))
EVERY = 5
"""Seconds between two samples: so a fifth of the work."""
FADED = 0.88
"""Of the capacity that the cell file has."""


def cycles(hours, *, rests, seed=1):
    """Current of one cell [A]: down in steps to SOC 0.25, up to 0.93, over and over."""
    rng = np.random.default_rng(seed)
    capacity_as, soc, parts = 3600.0 * TRUTH.cell.capacity_ah, 0.95, [np.zeros(600)]
    while sum(map(len, parts)) < 3600 * hours:
        while soc > 0.25:
            step_a, step_s = rng.choice([1.0, 2.0, 3.0]), rng.integers(20, 400)
            soc -= step_a * step_s / capacity_as
            parts += [np.full(step_s, step_a), np.zeros(rng.integers(60, 600) if rests else 0)]
        charge_s = int((0.93 - soc) * capacity_as / 2.0)
        soc += 2.0 * charge_s / capacity_as
        parts += [np.full(charge_s, -2.0), np.zeros(1200 if rests else 0)]
    return FADED * np.concatenate(parts)[: 3600 * hours]


def pack_samples(hours, *, rests=True):
    """What a pack of faded cells sends."""
    faded = TRUTH.model_copy(update={"cell": TRUTH.cell.model_copy(update={"capacity_ah": FADED * 3.0})})
    samples = capture(cycles(hours, rests=rests), cell=faded, soc=0.95)
    samples["voltage_v"] *= SERIES
    samples["current_a"] *= PARALLEL
    samples["temperature_c"] = 25.0  # the simulated cell does not warm itself: without a sensor it would be taken to
    return samples[::EVERY]


@pytest.fixture(scope="module")
def samples():
    return pack_samples(10)


def test_a_pack_that_has_aged_gets_a_better_cell(samples):
    found = reidentify("house", samples, KIND, WRONG)
    assert found.reason == ""
    assert found.rms_v < 0.3 * found.rms_before_v
    assert found.capacity_before_ah == pytest.approx(3.0)
    assert abs(found.capacity_ah - FADED * 3.0) < 2.0 * found.capacity_std_ah
    cell = parse_toml(found.cell_file, CellModel, "new")
    assert (cell.cell.name, cell.cell.series_count) == ("of-house", 1)
    assert cell.cell.capacity_ah == pytest.approx(found.capacity_ah)
    assert found.r_s_ohm == pytest.approx(TRUTH.a[13] * np.exp(-0.5 * TRUTH.a[14]) + TRUTH.a[15], rel=0.05)


def test_what_is_no_better_is_not_taken(samples):
    right = TRUTH.model_copy(update={"cell": TRUTH.cell.model_copy(update={"capacity_ah": FADED * 3.0})})
    found = reidentify("house", samples, KIND, cell_text(right))
    assert (found.cell_file, found.reason) == ("", "not better than the cell that it has")
    assert found.rms_v > 0.97 * found.rms_before_v


@pytest.mark.parametrize(
    ("change", "kind", "reason"),
    [
        (lambda s: s[: 720 * 3], KIND, "3.0 h of samples: at least 6 h are needed"),
        (lambda s: s[:0], KIND, "0.0 h of samples"),
        (lambda s: s[::20], KIND, "0.00 capacities were moved"),
        (lambda s: s[:60], PackSpec(cell="pem_30w"), "pem_30w is a fuel cell"),
        (lambda s: s, KIND.model_copy(update={"series": 7}), "no sample is one that this cell can have"),
        (lambda s: s, PackSpec(cell="nowhere"), "nowhere: no cell file of this name was loaded"),
    ],
)
def test_why_a_pack_cannot_be_identified_is_said(samples, change, kind, reason):
    text = WRONG if kind.cell == "own" else None
    found = reidentify("house", change(samples), kind, text)
    assert (found.cell_file, found.reason[: len(reason)]) == ("", reason)


def test_resting_for_days_tells_nothing(samples):
    resting = samples.copy()
    resting["current_a"] = 0.0
    assert "capacities were moved" in reidentify("house", resting, KIND, WRONG).reason


def test_gaps_and_steps_back_in_time_do_no_harm(samples):
    holes = np.concatenate([samples[:1800], samples[1860:3000], samples[2900:4000], samples[4200:]])
    assert reidentify("house", holes, KIND, WRONG).cell_file
