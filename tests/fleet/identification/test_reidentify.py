"""Re-identification of the cell of a pack from samples of the pack."""

import numpy as np
import pytest

from bms_estimator.fleet.identification.reidentify import reidentify, single_cell_settings
from bms_estimator.fleet.packs.pack_row import PackSpec
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_file import cell_text
from bms_estimator.model.config_file import parse_toml
from bms_estimator.settings.charge_limits import ChargeLimits
from tests.calibration.simulated_load import TRUTH, capture, wrong_start

SERIES, PARALLEL = 14, 4
PACK_SPEC = PackSpec(
    cell="own", series=SERIES, parallel=PARALLEL, voltage_resolution_v=0.01, current_resolution_a=0.01, period_s=5.0
)
WRONG_CELL_TOML = cell_text(wrong_start(1.3, 0.8))
"""Cell file with wrong circuit elements."""
PERIOD_S = 5
"""Interval between two samples [s]; at 1 s the test would take five times as long."""
CAPACITY_FADE = 0.88
"""True capacity divided by that of the cell file."""


def cycles(hours, *, rests, seed=1):
    """Return the current of one cell at 1 Hz [A]: discharges in steps to 25 % SOC, and charges to 93 % with 2 A."""
    rng = np.random.default_rng(seed)
    capacity_as, soc, currents_a = 3600.0 * TRUTH.cell.capacity_ah, 0.95, [np.zeros(600)]
    while sum(map(len, currents_a)) < 3600 * hours:
        while soc > 0.25:
            step_a, step_s = rng.choice([1.0, 2.0, 3.0]), rng.integers(20, 400)
            soc -= step_a * step_s / capacity_as
            currents_a += [np.full(step_s, step_a), np.zeros(rng.integers(60, 600) if rests else 0)]
        charge_s = int((0.93 - soc) * capacity_as / 2.0)
        soc += 2.0 * charge_s / capacity_as
        currents_a += [np.full(charge_s, -2.0), np.zeros(1200 if rests else 0)]
    return CAPACITY_FADE * np.concatenate(currents_a)[: 3600 * hours]


def pack_samples(hours, *, rests=True):
    """Return the samples of a pack whose cells have lost capacity."""
    aged = TRUTH.model_copy(update={"cell": TRUTH.cell.model_copy(update={"capacity_ah": CAPACITY_FADE * 3.0})})
    samples = capture(cycles(hours, rests=rests), cell=aged, soc=0.95)
    samples["voltage_v"] *= SERIES
    samples["current_a"] *= PARALLEL
    # without a measured temperature self-heating would be estimated, which the simulated cell does not have
    samples["temperature_c"] = 25.0
    return samples[::PERIOD_S]


@pytest.fixture(scope="module")
def samples():
    return pack_samples(10)


def test_pack_of_aged_cells_gets_a_better_cell_file(samples):
    result = reidentify("house", samples, PACK_SPEC, WRONG_CELL_TOML)
    assert result.reason == ""
    assert result.rms_v < 0.3 * result.rms_before_v
    assert result.capacity_before_ah == pytest.approx(3.0)
    assert abs(result.capacity_ah - CAPACITY_FADE * 3.0) < 2.0 * result.capacity_std_ah
    cell = parse_toml(result.cell_file, CellModel, "new")
    assert (cell.cell.name, cell.cell.series_count) == ("of-house", 1)
    assert cell.cell.capacity_ah == pytest.approx(result.capacity_ah)
    r_s_at_half_soc = TRUTH.a[13] * np.exp(-0.5 * TRUTH.a[14]) + TRUTH.a[15]  # series resistance of Chen and Mora
    assert result.r_s_ohm == pytest.approx(r_s_at_half_soc, rel=0.05)


def test_cell_that_is_not_better_is_not_used(samples):
    true_cell = TRUTH.model_copy(update={"cell": TRUTH.cell.model_copy(update={"capacity_ah": CAPACITY_FADE * 3.0})})
    result = reidentify("house", samples, PACK_SPEC, cell_text(true_cell))
    assert (result.cell_file, result.reason) == ("", "not better than the present cell")
    assert result.rms_v > 0.97 * result.rms_before_v


@pytest.mark.parametrize(
    ("select", "spec", "reason"),
    [
        (lambda s: s[: 720 * 3], PACK_SPEC, "3.0 h of samples: at least 6 h are needed"),
        (lambda s: s[:0], PACK_SPEC, "0.0 h of samples"),
        (lambda s: s[::20], PACK_SPEC, "0.00 capacities were charged"),
        (lambda s: s[:60], PackSpec(cell="pem_30w"), "pem_30w is a fuel cell"),
        (lambda s: s, PACK_SPEC.model_copy(update={"series": 7}), "no sample is plausible for this cell"),
        (lambda s: s, PackSpec(cell="nowhere"), "nowhere: no cell file of this name was loaded"),
    ],
)
def test_pack_without_a_new_cell_gets_the_reason(samples, select, spec, reason):
    text = WRONG_CELL_TOML if spec.cell == "own" else None
    result = reidentify("house", select(samples), spec, text)
    assert (result.cell_file, result.reason[: len(reason)]) == ("", reason)


def test_samples_at_rest_are_not_enough(samples):
    resting = samples.copy()
    resting["current_a"] = 0.0
    assert "capacities were charged" in reidentify("house", resting, PACK_SPEC, WRONG_CELL_TOML).reason


def test_samples_with_gaps_and_time_steps_back_give_a_cell(samples):
    disordered = np.concatenate([samples[:1800], samples[1860:3000], samples[2900:4000], samples[4200:]])
    assert reidentify("house", disordered, PACK_SPEC, WRONG_CELL_TOML).cell_file


def test_limits_and_offset_of_a_pack_are_converted_to_one_cell():
    limits = {"full_voltage_v": 58.1, "tail_current_a": 2.0, "cutoff_voltage_v": 42.0, "current_offset_std_a": 0.1}
    settings = single_cell_settings(PACK_SPEC.model_copy(update=limits))
    assert settings.charge_limits == ChargeLimits(58.1 / SERIES, 2.0 / PARALLEL, 42.0 / SERIES)
    assert settings.identifier.current_offset_std_a == 0.1 / PARALLEL
    assert settings.sensor.voltage_resolution_v == 0.01 / SERIES
    assert settings.sampling.current_resolution_a == 0.01 / PARALLEL
