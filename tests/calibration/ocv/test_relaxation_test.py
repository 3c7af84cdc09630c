"""Voltage relaxation tests of a simulated cell with known open-circuit voltage."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.calibration.cleaning.clean_capture import remove_glitches, soc_by_counting
from bms_estimator.calibration.ocv.chen_mora_fit import fit_chen_mora, pool_tests
from bms_estimator.calibration.ocv.relaxation_test import relaxation_test
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import TRUTH
from tests.calibration.simulated_relaxation import FIRST_REST_S, INVALID_CAPTURES, LOAD_S, REST_S, glitched, relaxation

CAPACITY_AH = TRUTH.cell.capacity_ah
ROUNDS = 19
"""Number of loads, each of 5 % of the charge."""


def true_ocv_v(soc):
    """Return the true open-circuit voltage at each SOC [V]."""
    grid = ocv_grid(TRUTH)
    return np.array([ocv(x, *grid) for x in soc])


@pytest.fixture(scope="module")
def noisy_test():
    """Return the relaxation test of the true cell with 0.5 mV of noise."""
    return relaxation_test(relaxation(), CAPACITY_AH, name="noisy")


def test_every_rest_is_found_with_its_time_and_soc(noisy_test):
    assert len(noisy_test.rests) == 1 + ROUNDS
    assert noisy_test.rejected == ()
    assert noisy_test.glitches == 0
    starts = [0.0] + [FIRST_REST_S + LOAD_S + j * (LOAD_S + REST_S) for j in range(ROUNDS)]
    assert [rest.start_s for rest in noisy_test.rests] == starts
    assert [rest.duration_s for rest in noisy_test.rests] == [FIRST_REST_S - 1.0] + [REST_S - 1.0] * ROUNDS
    assert noisy_test.soc == pytest.approx(1.0 - 0.05 * np.arange(1 + ROUNDS), abs=1e-9)
    assert noisy_test.full_v == pytest.approx(true_ocv_v([1.0])[0], abs=2e-3)


def test_the_temperature_is_the_mean_of_the_rests_that_have_one(noisy_test):
    rests = [replace(rest, temperature_c=c) for rest, c in zip(noisy_test.rests, (-10.0, -12.0, np.nan), strict=False)]
    assert replace(noisy_test, rests=tuple(rests)).temperature_c == pytest.approx(-11.0)
    assert np.isnan(replace(noisy_test, rests=tuple(rests[2:])).temperature_c)


def test_points_lie_on_the_open_circuit_voltage(noisy_test):
    error_v = noisy_test.ocv_v - true_ocv_v(noisy_test.soc)
    assert np.abs(error_v).max() < 3e-3
    assert np.sqrt(np.mean(error_v**2)) < 1e-3


def test_the_extrapolated_ocv_is_nearer_than_the_last_voltage_of_a_rest_and_within_its_std():
    extrapolated_error_v, end_error_v, is_within_std = [], [], []
    for seed in range(4):
        result = relaxation_test(relaxation(seed=seed), CAPACITY_AH, name="mine")
        loaded = [rest for rest in result.rests if rest.soc < 0.99]  # rests after a load
        true_v = true_ocv_v([rest.soc for rest in loaded])
        extrapolated_error_v.append(result.ocv_v[1:] - true_v)
        end_error_v.append([rest.voltage_v for rest in loaded] - true_v)
        is_within_std.append(np.abs(extrapolated_error_v[-1]) < 2.0 * result.std_v[1:])
        assert [rest.remaining_v for rest in loaded] == pytest.approx(
            [rest.ocv_v - rest.voltage_v for rest in loaded], abs=1e-15
        )
    assert np.sqrt(np.mean(np.square(extrapolated_error_v))) < 0.5 * np.sqrt(np.mean(np.square(end_error_v)))
    assert np.mean(is_within_std) > 0.95
    assert np.mean(end_error_v) < -1.5e-3  # at the end of a rest, the voltage still rises


def test_without_noise_a_long_rest_is_extrapolated_to_a_fifth_of_a_millivolt():
    result = relaxation_test(relaxation(noise_v=0.0), CAPACITY_AH, name="mine")
    assert np.abs(result.ocv_v - true_ocv_v(result.soc)).max() < 2e-4


@pytest.mark.parametrize("rest_s", [240, 400, 3600])
def test_rests_of_any_length_are_within_their_std(rest_s):
    result = relaxation_test(relaxation(rest_s=rest_s, rounds=ROUNDS), CAPACITY_AH, name="mine")
    assert len(result.rests) + len(result.rejected) == 1 + ROUNDS
    # only the last of the rests of 240 s may be rejected, because near empty the time constants are long
    assert len(result.rejected) <= (1 if rest_s == 240 else 0)
    error_v = np.abs(result.ocv_v - true_ocv_v(result.soc))
    max_error_v = {240: 0.016, 400: 8e-3, 3600: 1e-3}[rest_s]
    assert error_v.max() < max_error_v
    assert np.sqrt(np.mean((error_v / result.std_v) ** 2)) < 1.3


def test_a_longer_rest_is_more_certain():
    stds = [
        np.median(relaxation_test(relaxation(rest_s=s, rounds=8), CAPACITY_AH, name="mine").std_v)
        for s in (240, 900, 3600)
    ]
    assert stds[0] > stds[1] > stds[2]


@pytest.mark.parametrize("noise_v", [1e-3, 2e-3, 5e-3])
def test_noise_makes_points_uncertain_but_not_wrong(noise_v):
    """The noise is up to five times the remaining relaxation at the end of a rest, so that the time constant is
    uncertain."""
    errors_over_std, error_v = [], []
    for seed in range(3):
        result = relaxation_test(relaxation(noise_v=noise_v, seed=seed), CAPACITY_AH, name="mine")
        assert len(result.rests) >= ROUNDS  # the minute before the first load may be too short
        error_v.append(result.ocv_v - true_ocv_v(result.soc))
        errors_over_std.append(error_v[-1] / result.std_v)
    assert np.sqrt(np.mean(np.concatenate(errors_over_std) ** 2)) < 1.2
    assert np.sqrt(np.mean(np.concatenate(error_v) ** 2)) < 2e-3


@pytest.mark.parametrize("every", [10, 30])
def test_a_sample_every_10_or_30_s_gives_points_on_the_ocv(every):
    result = relaxation_test(relaxation()[::every], CAPACITY_AH, name="mine")
    assert len(result.rests) >= ROUNDS
    error_v = result.ocv_v - true_ocv_v(result.soc)
    assert np.sqrt(np.mean((error_v / result.std_v) ** 2)) < 1.0
    assert np.sqrt(np.mean(error_v**2)) < 1.5e-3


def test_real_rests_cut_in_half_are_extrapolated_towards_their_end(shared_data):
    """Rests of half an hour of an NCR18650 are cut to 15 min. The voltage after half an hour is the reference."""
    samples = load_capture(shared_data / "ncr18650" / "cell1_dst.csv.gz").rows
    uncut_test = relaxation_test(samples, 3.1, initial_soc=1.0, name="mine")
    is_cut = np.zeros(samples.size, dtype=bool)
    long_rests = [rest for rest in uncut_test.rests if 1700.0 < rest.duration_s < 3000.0 and rest.soc < 0.99]
    assert len(long_rests) >= 15
    for rest in long_rests:
        is_cut |= (samples["time_s"] > rest.start_s + 900.0) & (samples["time_s"] <= rest.start_s + rest.duration_s)
    cut_rests = {
        rest.start_s: rest for rest in relaxation_test(samples[~is_cut], 3.1, initial_soc=1.0, name="mine").rests
    }
    extrapolated_error_v = np.array([cut_rests[rest.start_s].ocv_v - rest.voltage_v for rest in long_rests])
    end_voltage_error_v = np.array([cut_rests[rest.start_s].voltage_v - rest.voltage_v for rest in long_rests])
    std_v = np.array([cut_rests[rest.start_s].std_v for rest in long_rests])
    assert np.sqrt(np.mean(extrapolated_error_v**2)) < 0.6 * np.sqrt(np.mean(end_voltage_error_v**2))
    assert np.sqrt(np.mean((extrapolated_error_v / std_v) ** 2)) < 1.5


def test_glitches_of_the_current_sensor_do_not_end_a_rest():
    samples = relaxation()
    within_rest = FIRST_REST_S + LOAD_S + 300
    samples["current_a"][within_rest] = 0.05
    samples["current_a"] += 0.005 * np.random.default_rng(2).standard_normal(samples.size)
    result = relaxation_test(samples, CAPACITY_AH, name="mine")
    assert len(result.rests) == 1 + ROUNDS


@pytest.mark.parametrize(("noise_a", "step_a"), [(0.02, 1e-4), (0.05, 1e-4), (0.1, 1e-4), (0.025, 0.05), (0.002, 0.05)])
def test_rests_are_found_with_noise_and_rounding_of_the_current_sensor(noisy_test, noise_a, step_a):
    """The noise is up to seven times the maximum current of a rest. 0.05 A is the resolution of a ten-bit sensor."""
    samples = relaxation()
    noise = noise_a * np.random.default_rng(8).standard_normal(samples.size)
    samples["current_a"] = np.rint((samples["current_a"] + noise) / step_a) * step_a
    result = relaxation_test(samples, CAPACITY_AH, name="mine")
    assert len(result.rests) == 1 + ROUNDS
    assert [rest.start_s for rest in result.rests] == pytest.approx(
        [rest.start_s for rest in noisy_test.rests], abs=2.0
    )
    assert result.soc == pytest.approx(noisy_test.soc, abs=5e-3)


@pytest.mark.parametrize("share", [0.001, 0.02, 0.4])
def test_glitches_to_0_v_are_dropped_and_counted(noisy_test, share):
    samples = glitched(share)
    result = relaxation_test(samples, CAPACITY_AH, name="mine")
    assert result.glitches == (samples["voltage_v"] == 0.0).sum()
    assert result.soc == pytest.approx(noisy_test.soc, abs=1e-3)
    assert result.ocv_v == pytest.approx(noisy_test.ocv_v, abs=4e-3)


def test_nan_and_repeated_time_stamps_are_dropped():
    samples = relaxation(rounds=2)
    samples["voltage_v"][10] = np.nan
    samples["time_s"][20] = samples["time_s"][19]
    samples["time_s"][30] = 0.0
    cleaned = remove_glitches(samples, "mine")
    assert cleaned.size == samples.size - 3
    assert (np.diff(cleaned["time_s"]) > 0.0).all()


def test_charge_is_counted_over_uneven_steps():
    samples = np.zeros(4, dtype=SAMPLE)
    samples["time_s"] = [0.0, 10.0, 11.0, 3611.0]
    samples["current_a"] = [3.6, 0.0, 1.0, 5.0]  # 36 As, nothing, 3600 As
    assert soc_by_counting(samples, 2.0, 0.9) == pytest.approx([0.9, 0.895, 0.895, 0.395])


@pytest.mark.parametrize("fault", INVALID_CAPTURES)
def test_bad_input_is_rejected_with_its_numbers(fault):
    simulate, capacity_ah, message = INVALID_CAPTURES[fault]
    samples = simulate()
    with pytest.raises(UserError) as caught:
        fit_chen_mora(pool_tests([relaxation_test(samples, capacity_ah, name="mine")]))
    assert message in str(caught.value)


def test_short_rests_are_listed_with_their_lengths():
    simulate, capacity_ah, _ = INVALID_CAPTURES["short rests"]
    with pytest.raises(UserError, match="rest at 420 s: 19 s long, shorter than 30 s"):
        relaxation_test(simulate(), capacity_ah, name="mine")


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
    """In a file with pulses at several SOCs, each from 0 s, the charge between them is unknown."""
    pulse = relaxation(rounds=2)
    for later_captures in (1, 2):
        concatenated = np.concatenate([pulse] * (1 + later_captures))
        with pytest.raises(
            UserError,
            match=rf"mine: time goes back {later_captures} times, first from \d.* to 0 s, .* a file of its own",
        ):
            remove_glitches(concatenated, "mine")
    single_jump = pulse.copy()
    single_jump["time_s"][50] -= 30.0
    assert remove_glitches(single_jump, "mine").size == pulse.size - 1
