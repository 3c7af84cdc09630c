"""Bad input: the identifier stays finite, says what it suspects, and comes back when the input is good again."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.kernels.identifier_state import SOC
from bms_estimator.model.suspect import Suspect
from tests.kernels import identifier_cases as cases

FAULT_S = (3600.0, 7200.0)
"""The hour in which the input is bad."""
NCR = cases.cell("ncr18650")
Fault = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def during(time_s: np.ndarray) -> np.ndarray:
    return (time_s - time_s[0] >= FAULT_S[0]) & (time_s - time_s[0] < FAULT_S[1])


def now_and_then(time_s: np.ndarray) -> np.ndarray:
    return during(time_s) & (np.random.default_rng(1).random(len(time_s)) < 0.01)


def flipped(t: np.ndarray, i: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return t, np.where(during(t), -i, i), v


def offset(t: np.ndarray, i: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1 % of a range of 5 A."""
    return t, i + 0.05 * during(t), v


def glitches(t: np.ndarray, i: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return t, i, np.where(now_and_then(t), 0.0, v)


def spikes(t: np.ndarray, i: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return t, np.where(now_and_then(t), 4.6, i), v


def repeated(t: np.ndarray, i: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    times = np.where(during(t), 3, 1)
    return np.repeat(t, times), np.repeat(i, times), np.repeat(v, times)


def identify(folder: Path, name: str, fault: Fault | None = None, **kwargs: float) -> cases.Run:
    """A capture with a fault, its truth at every sample that is left."""
    time_s, current_a, voltage_v, soc = cases.capture(folder, name)
    settings = cases.settings(NCR, soc[0] - 0.2, **kwargs)
    if fault is None:
        return cases.identify(settings, time_s, current_a, voltage_v, soc)
    faulty_s, current_a, voltage_v = fault(time_s, current_a, voltage_v)
    first = np.searchsorted(time_s, faulty_s)
    return cases.identify(settings, faulty_s, current_a, voltage_v, soc[first])


def is_sane(run: cases.Run) -> bool:
    """Whether state and trace are finite."""
    x = run.state[0]
    numbers = [run.trace["soc"], run.trace["soc_std"], run.trace["ln"], x["mean"], x["covariance"]]
    return all(bool(np.isfinite(n).all()) for n in numbers)


@pytest.mark.parametrize("name", ["cell5_random_steps", "cell1_dst", "cell1_hppc"])
@pytest.mark.parametrize("fault", [flipped, offset, glitches, spikes, repeated])
def test_an_hour_of_bad_input(shared_data: Path, name: str, fault: Fault) -> None:
    """Within an hour of good input the SOC is right again, and stays so."""
    run = identify(shared_data, name, fault)
    assert is_sane(run)
    assert np.abs(run.error[run.after(FAULT_S[1] + 3600.0)]).max() < 0.02


@pytest.mark.parametrize("name", ["cell5_random_steps", "cell1_dst", "cell1_hppc"])
@pytest.mark.parametrize(
    ("fault", "suspect"),
    [(flipped, Suspect.SIGN_OF_CURRENT), (glitches, Suspect.OUTLIERS), (spikes, Suspect.OUTLIERS)],
)
def test_a_passing_fault_is_named_and_then_forgotten(
    shared_data: Path, name: str, fault: Fault, suspect: Suspect
) -> None:
    run = identify(shared_data, name, fault)
    named = run.trace["suspects"] & suspect != 0
    assert named[during(run.time_s)].any()
    assert not named[~run.after(FAULT_S[0], 0.0)].any()
    assert not named[-1]


@pytest.mark.parametrize("name", ["cell5_random_steps", "cell1_dst", "cell1_hppc"])
@pytest.mark.parametrize("offset_a", [0.05, -0.05, 0.15])
def test_an_offset_of_the_current_is_suspected(shared_data: Path, name: str, offset_a: float) -> None:
    """1 % of a range of 5 A, and of the 15 A that the cell may carry: 5 % of its charge in an hour."""
    run = identify(shared_data, name, lambda t, i, v: (t, i + offset_a, v))
    assert is_sane(run)
    assert Suspect.OFFSET in run.suspected()
    assert np.abs(run.error[run.after(3600.0)]).max() < 0.06


@pytest.mark.parametrize("name", ["cell5_random_steps", "cell5_relaxation_c2", "cell1_dst", "cell1_hppc"])
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_wrong_capacity_is_suspected(shared_data: Path, name: str, factor: float) -> None:
    run = identify(shared_data, name, capacity_ah=factor * cases.PROTOCOL_CAPACITY_AH)
    assert is_sane(run)
    assert Suspect.CAPACITY in run.suspected()
    assert np.abs(run.error[run.after(3600.0)]).max() < 0.1


@pytest.mark.parametrize("name", ["cell5_random_steps", "cell1_dst", "cell1_hppc"])
def test_the_ocv_of_another_chemistry_is_suspected(shared_data: Path, name: str) -> None:
    """An iron-phosphate curve: a plateau at 3.3 V."""
    soc = np.linspace(0.0, 1.0, len(cases.settings(NCR, 0.5)["ocv_v"][0]))
    plateau_v = 3.275 + 0.05 * soc + 0.1 * np.tanh((soc - 0.98) * 40.0) - 0.5 * np.exp(-25.0 * soc)
    time_s, current_a, voltage_v, truth = cases.capture(shared_data, name)
    settings = cases.settings(NCR, truth[0] - 0.2)
    settings["ocv_v"], settings["ocv_slope_v"] = plateau_v, np.gradient(plateau_v, soc)
    run = cases.identify(settings, time_s, current_a, voltage_v, truth)
    assert is_sane(run)
    assert Suspect.OCV in run.suspected()


@pytest.mark.parametrize("name", sorted(cases.INITIAL_SOC))
@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_nothing_is_suspected_of_a_good_capture(shared_data: Path, name: str, factor: float) -> None:
    wrong_soc = 0.2 if name == "cell1_charge_c20" else -0.2
    assert cases.identify_capture(shared_data, name, (factor,) * 5, wrong_soc).suspected() == 0


def test_a_gap_of_an_hour(shared_data: Path) -> None:
    """What the current did meanwhile is not known, and the std says so."""
    time_s, current_a, voltage_v, soc = cases.capture(shared_data, "cell5_random_steps")
    kept = ~during(time_s)
    settings = cases.settings(NCR, soc[0] - 0.2)
    run = cases.identify(settings, time_s[kept], current_a[kept], voltage_v[kept], soc[kept])
    assert is_sane(run)
    before, after = np.searchsorted(run.time_s - run.time_s[0], FAULT_S)
    assert run.trace["soc_std"][after] > run.trace["soc_std"][before - 1]
    assert np.abs(run.error[run.after(FAULT_S[1] + 3600.0)]).max() < 0.02
    assert run.coverage() > 0.9


def test_garbage_for_hours() -> None:
    """Any numbers at all: nothing overflows, and the cell is found again afterwards."""
    model = cases.cell("chen_mora")
    time_s, current_a = cases.pulses(3.0, 1.0, 0.4 * model.cell.capacity_ah, both_ways=True)
    x = cases.simulate(model, time_s, current_a, soc=0.6)
    settings = cases.settings(model, 0.6, noise_v=x.noise_v, resolution_v=x.resolution_v)
    state = cases.new_state(settings)
    rng = np.random.default_rng(0)
    garbage_a, garbage_v = rng.normal(0.0, 1.0, 10_000) ** 9, rng.normal(3.0, 2.0, 10_000) ** 5
    cases.fast(state, settings, 1.0, garbage_a, garbage_v)
    assert np.isfinite(state[0]["mean"]).all()
    assert np.isfinite(state[0]["covariance"]).all()
    cases.fast(state, settings, 1.0, current_a, x.voltage_v)
    assert state[0]["mean"][SOC] == pytest.approx(x.soc[-1], abs=0.02)


def test_every_suspect_says_what_to_do() -> None:
    for suspect in Suspect:
        assert "check" in suspect.text
    both = Suspect.OFFSET | Suspect.CAPACITY
    assert Suspect.OFFSET.text in both.text
    assert Suspect.CAPACITY.text in both.text
    assert not Suspect(0).text
