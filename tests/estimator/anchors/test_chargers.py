"""Full anchors (SOC 1) at the ends of simulated charges: found only at a full cell, with an error within their std."""

import pytest

from tests.estimator.anchors.chargers import anchors, cases

MAX_STDS = 1.25
"""Maximum error of an anchor's SOC, as a multiple of its std. All chargers stop before SOC 1, so that the error has one sign."""
CASES = {case.name: case for case in cases()}


@pytest.mark.parametrize(
    "name",
    [
        "nmc 0.5C to C/200",
        "nmc 0.5C to C/10",
        "nmc held for 8 h, current noise 1 % C",
        "nmc loads of 0.2C in parallel",
        "nmc 0.08C that a cloud ends at 0.996 of the voltage",
        "nmc 0.2C to C/20, samples each 60 s",
        "lfp 0.2C to C/10",
        "lfp 0.2C to C/5",
        "lfp 0.5C to C/10",
        "lfp 0.5C to C/8",
        "lfp 0.2C to C/20, samples each 60 s",
        "lfp 0.3C to C/30, steps of 0.1 A, dead band 2.5 A",
        "lfp 0.5C, 600 s at 3.55 V, float at 3.375 V",
        "lfp 3600 s at 3.45 V",
        "lfp sun falls from 1.0C to 0.1C",
    ],
)
def test_end_of_a_charge_is_full_within_its_std(name: str) -> None:
    found = anchors(CASES[name], CASES[name].charged())
    assert len(found) == 1
    assert 1.0 - found[0].true_soc < MAX_STDS * found[0].std


def test_charge_that_a_load_interrupts_has_two_full_anchors() -> None:
    case = CASES["lfp load of 0.5C switched on at C/8, for 10 min"]
    found = anchors(case, case.charged())
    assert len(found) == 2
    assert all(1.0 - anchor.true_soc < MAX_STDS * anchor.std for anchor in found)


@pytest.mark.parametrize(
    "name",
    [
        "nmc 0.5C to C/5",
        "nmc sun falls from 0.5C to 0.12C",
        "nmc protection of a high cell stops 0.5C at 0.996 of the voltage, 6 times",
        "lfp protection of a high cell stops 0.5C at 0.996 of the voltage, 6 times",
        "lfp held at 3.375 V",
    ],
)
def test_end_of_a_charge_with_a_large_overpotential_or_a_low_voltage_is_not_full(name: str) -> None:
    assert anchors(CASES[name], CASES[name].charged()) == []
