"""Voltage relaxation tests of a simulated cell with known open-circuit voltage."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.calibration.cleaning.rests import remove_glitches, soc_by_counting
from bms_estimator.calibration.ocv.chen_mora_fit import fit_chen_mora
from bms_estimator.calibration.ocv.points import pooled
from bms_estimator.calibration.ocv.relaxation_test import relaxation_test
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SAMPLE
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import TRUTH
from tests.calibration.simulated_relaxation import BAD, FIRST_REST_S, LOAD_S, REST_S, glitched, relaxation

CAPACITY_AH = TRUTH.cell.capacity_ah
ROUNDS = 19
"""Number of loads, each of 5 % of the charge."""


def true_ocv(soc):
    grid = ocv_grid(TRUTH)
    return np.array([ocv(x, *grid) for x in soc])


@pytest.fixture(scope="module")
def noisy():
    return relaxation_test(relaxation(), CAPACITY_AH, name="noisy")


def test_every_rest_is_found_at_its_time_and_soc(noisy):
    assert len(noisy.rests) == 1 + ROUNDS
    assert noisy.rejected == ()
    assert noisy.glitches == 0
    starts = [0.0] + [FIRST_REST_S + LOAD_S + j * (LOAD_S + REST_S) for j in range(ROUNDS)]
    assert [rest.start_s for rest in noisy.rests] == starts
    assert [rest.duration_s for rest in noisy.rests] == [FIRST_REST_S - 1.0] + [REST_S - 1.0] * ROUNDS
    assert noisy.soc == pytest.approx(1.0 - 0.05 * np.arange(1 + ROUNDS), abs=1e-9)
    assert noisy.full_v == pytest.approx(true_ocv([1.0])[0], abs=2e-3)


def test_temperature_is_the_mean_of_the_rests_with_a_sensor(noisy):
    rests = [replace(rest, temperature_c=c) for rest, c in zip(noisy.rests, (-10.0, -12.0, np.nan), strict=False)]
    assert replace(noisy, rests=tuple(rests)).temperature_c == pytest.approx(-11.0)
    assert np.isnan(replace(noisy, rests=tuple(rests[2:])).temperature_c)


def test_points_lie_on_the_open_circuit_voltage(noisy):
    error_v = noisy.ocv_v - true_ocv(noisy.soc)
    assert np.abs(error_v).max() < 3e-3
    assert np.sqrt(np.mean(error_v**2)) < 1e-3


def test_extrapolation_is_nearer_than_the_end_voltage_and_within_its_std():
    seen, at_end, within = [], [], []
    for seed in range(4):
        found = relaxation_test(relaxation(seed=seed), CAPACITY_AH, name="mine")
        loaded = [rest for rest in found.rests if rest.soc < 0.99]
        true_v = true_ocv([rest.soc for rest in loaded])
        seen.append(found.ocv_v[1:] - true_v)
        at_end.append([rest.voltage_v for rest in loaded] - true_v)
        within.append(np.abs(seen[-1]) < 2.0 * found.std_v[1:])
        assert [rest.remaining_v for rest in loaded] == pytest.approx(
            [rest.ocv_v - rest.voltage_v for rest in loaded], abs=1e-15
        )
    assert np.sqrt(np.mean(np.square(seen))) < 0.5 * np.sqrt(np.mean(np.square(at_end)))
    assert np.mean(within) > 0.95
    assert np.mean(at_end) < -1.5e-3  # the voltage still rises


def test_without_noise_a_long_rest_is_extrapolated_to_a_fifth_of_a_millivolt():
    found = relaxation_test(relaxation(noise_v=0.0), CAPACITY_AH, name="mine")
    assert np.abs(found.ocv_v - true_ocv(found.soc)).max() < 2e-4


@pytest.mark.parametrize("rest_s", [240, 400, 3600])
def test_rests_of_any_length_are_within_their_std(rest_s):
    found = relaxation_test(relaxation(rest_s=rest_s, rounds=ROUNDS), CAPACITY_AH, name="mine")
    assert len(found.rests) + len(found.rejected) == 1 + ROUNDS
    assert len(found.rejected) <= (rest_s < 400)  # the last rest, at a low SOC where the elements rise
    error_v = np.abs(found.ocv_v - true_ocv(found.soc))
    assert error_v.max() < {240: 0.016, 400: 8e-3, 3600: 1e-3}[rest_s]
    assert np.sqrt(np.mean((error_v / found.std_v) ** 2)) < 1.3  # errors match their std


def test_a_longer_rest_is_more_certain():
    stds = [
        np.median(relaxation_test(relaxation(rest_s=s, rounds=8), CAPACITY_AH, name="mine").std_v)
        for s in (240, 900, 3600)
    ]
    assert stds[0] > stds[1] > stds[2]


@pytest.mark.parametrize("noise_v", [1e-3, 2e-3, 5e-3])
def test_noise_makes_points_uncertain_but_not_wrong(noise_v):
    """The noise is up to five times the remaining relaxation at a rest's end, so that the time constant is uncertain."""
    score, error_v = [], []
    for seed in range(3):
        found = relaxation_test(relaxation(noise_v=noise_v, seed=seed), CAPACITY_AH, name="mine")
        assert len(found.rests) >= ROUNDS  # the minute before the first load may be too short
        error_v.append(found.ocv_v - true_ocv(found.soc))
        score.append(error_v[-1] / found.std_v)
    assert np.sqrt(np.mean(np.concatenate(score) ** 2)) < 1.2
    assert np.sqrt(np.mean(np.concatenate(error_v) ** 2)) < 2e-3


@pytest.mark.parametrize("every", [10, 30])
def test_slow_sampling_gives_points_on_the_ocv(every):
    found = relaxation_test(relaxation()[::every], CAPACITY_AH, name="mine")
    assert len(found.rests) >= ROUNDS
    error_v = found.ocv_v - true_ocv(found.soc)
    assert np.sqrt(np.mean((error_v / found.std_v) ** 2)) < 1.0
    assert np.sqrt(np.mean(error_v**2)) < 1.5e-3


def test_real_rests_cut_in_half_are_extrapolated_towards_their_end(shared_data):
    """Half-hour rests of an NCR18650, cut to their first quarter of an hour."""
    samples = load_capture(shared_data / "ncr18650" / "cell1_dst.csv.gz").rows
    whole = relaxation_test(samples, 3.1, initial_soc=1.0, name="mine")
    cut = np.zeros(samples.size, dtype=bool)
    long = [rest for rest in whole.rests if 1700.0 < rest.duration_s < 3000.0 and rest.soc < 0.99]
    assert len(long) >= 15
    for rest in long:
        cut |= (samples["time_s"] > rest.start_s + 900.0) & (samples["time_s"] <= rest.start_s + rest.duration_s)
    half = {rest.start_s: rest for rest in relaxation_test(samples[~cut], 3.1, initial_soc=1.0, name="mine").rests}
    left = np.array([half[rest.start_s].ocv_v - rest.voltage_v for rest in long])
    unextrapolated = np.array([half[rest.start_s].voltage_v - rest.voltage_v for rest in long])
    std_v = np.array([half[rest.start_s].std_v for rest in long])
    assert np.sqrt(np.mean(left**2)) < 0.6 * np.sqrt(np.mean(unextrapolated**2))
    assert np.sqrt(np.mean((left / std_v) ** 2)) < 1.5


def test_glitches_of_the_current_sensor_do_not_end_a_rest():
    samples = relaxation()
    inside = FIRST_REST_S + LOAD_S + 300
    samples["current_a"][inside] = 0.05
    samples["current_a"] += 0.005 * np.random.default_rng(2).standard_normal(samples.size)
    found = relaxation_test(samples, CAPACITY_AH, name="mine")
    assert len(found.rests) == 1 + ROUNDS


@pytest.mark.parametrize(("noise_a", "step_a"), [(0.02, 1e-4), (0.05, 1e-4), (0.1, 1e-4), (0.025, 0.05), (0.002, 0.05)])
def test_rests_are_found_with_noise_and_rounding_of_the_current_sensor(noisy, noise_a, step_a):
    """Noise up to seven times the maximum current of a rest, and the resolution of a common ten-bit sensor."""
    samples = relaxation()
    noise = noise_a * np.random.default_rng(8).standard_normal(samples.size)
    samples["current_a"] = np.rint((samples["current_a"] + noise) / step_a) * step_a
    found = relaxation_test(samples, CAPACITY_AH, name="mine")
    assert len(found.rests) == 1 + ROUNDS
    assert [rest.start_s for rest in found.rests] == pytest.approx([rest.start_s for rest in noisy.rests], abs=2.0)
    assert found.soc == pytest.approx(noisy.soc, abs=5e-3)


@pytest.mark.parametrize("share", [0.001, 0.02, 0.4])
def test_glitches_to_0_v_are_dropped_and_counted(noisy, share):
    samples = glitched(share)
    found = relaxation_test(samples, CAPACITY_AH, name="mine")
    assert found.glitches == (samples["voltage_v"] == 0.0).sum()
    assert found.soc == pytest.approx(noisy.soc, abs=1e-3)
    assert found.ocv_v == pytest.approx(noisy.ocv_v, abs=4e-3)


def test_nan_and_repeated_time_stamps_are_dropped():
    samples = relaxation(rounds=2)
    samples["voltage_v"][10] = np.nan
    samples["time_s"][20] = samples["time_s"][19]
    samples["time_s"][30] = 0.0
    kept = remove_glitches(samples, "mine")
    assert kept.size == samples.size - 3
    assert (np.diff(kept["time_s"]) > 0.0).all()


def test_charge_is_counted_over_uneven_steps():
    samples = np.zeros(4, dtype=SAMPLE)
    samples["time_s"] = [0.0, 10.0, 11.0, 3611.0]
    samples["current_a"] = [3.6, 0.0, 1.0, 5.0]  # 36 As, nothing, 3600 As
    assert soc_by_counting(samples, 2.0, 0.9) == pytest.approx([0.9, 0.895, 0.895, 0.395])


@pytest.mark.parametrize("why", BAD)
def test_bad_input_is_rejected_with_its_numbers(why):
    make, capacity_ah, message = BAD[why]
    samples = make()
    with pytest.raises(UserError) as refused:
        fit_chen_mora(pooled([relaxation_test(samples, capacity_ah, name="mine")]))
    assert message in str(refused.value)


def test_short_rests_are_listed_with_their_lengths():
    make, capacity_ah, _ = BAD["short rests"]
    with pytest.raises(UserError, match="rest at 420 s: 19 s long, shorter than 30 s"):
        relaxation_test(make(), capacity_ah, name="mine")


@pytest.mark.parametrize(
    ("voltage_v", "message"),
    [(0.0, "mine: none of 900 samples has a voltage above 0 V"), (np.nan, "mine: none of 900 samples has finite")],
)
def test_captures_of_a_dead_instrument_are_rejected(voltage_v, message):
    samples = relaxation(rounds=1)[:900]
    samples["voltage_v"] = voltage_v
    with pytest.raises(UserError, match=message):
        relaxation_test(samples, CAPACITY_AH, name="mine")


def test_several_captures_in_one_file_are_rejected():
    """A file with pulses at several SOCs, each from 0 s, has unknown charge between them."""
    pulse = relaxation(rounds=2)
    for more in (1, 2):
        together = np.concatenate([pulse] * (1 + more))
        with pytest.raises(
            UserError, match=rf"mine: time goes back {more} times, first from \d.* to 0 s, .* a file of its own"
        ):
            remove_glitches(together, "mine")
    late = pulse.copy()
    late["time_s"][50] -= 30.0  # one wrong time stamp
    assert remove_glitches(late, "mine").size == pulse.size - 1
