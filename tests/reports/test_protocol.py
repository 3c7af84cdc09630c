"""Chapter 5 on captures: what each serves for, and what it needs."""

import numpy as np
import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.reports.protocol import Capture, Kind, Protocol, kind_of
from tests.calibration.simulated_load import TRUTH, capture, constant, steps
from tests.calibration.simulated_relaxation import relaxation

CAPACITY_AH = TRUTH.cell.capacity_ah
SERVES = {"relaxation": Kind.RELAXATION, "constant": Kind.CONSTANT, "steps": Kind.STEPS}


@pytest.fixture(scope="module")
def samples():
    return {
        "relaxation": relaxation(),
        "constant": capture(constant(1.0, 12_000), soc=1.0),
        "steps": capture(steps(2), soc=0.98),
    }


@pytest.fixture(scope="module")
def protocol(samples):
    captures = [Capture(name, kind_of(name, block, CAPACITY_AH), block) for name, block in samples.items()]
    return Protocol(TRUTH, captures, 1e-3)


@pytest.mark.parametrize("noise_a", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("name", SERVES)
def test_kind_of_a_capture(samples, name, noise_a):
    block = samples[name].copy()
    block["current_a"] += noise_a * np.random.default_rng(0).standard_normal(block.size)
    assert kind_of(name, block, CAPACITY_AH) is SERVES[name]


def test_start_of_each_capture(protocol):
    start = {c.name: protocol.initial_soc(c) for c in protocol.captures}
    assert (start["relaxation"], start["constant"]) == (1.0, 1.0)
    assert start["steps"] == pytest.approx(0.98, abs=0.01)


def test_frozen_model_is_validated_on_other_loads(protocol):
    """(5.3) as Table 11; the elements' sum is made right by (4.2), on loads it was not fitted to."""
    assert list(protocol.dynamic) == ["constant", "steps"]
    for run in protocol.dynamic.values():
        assert run.mean_percent < 1.0
        assert run.mean_percent < run.max_percent < 10.0
        assert run.soc.min() >= 0.05
    assert protocol.r_s_fit.a[2] > 0.0
    assert protocol.smallest.name == protocol.largest == "constant"


def test_static_model_is_another(protocol):
    for name, run in protocol.static.items():
        assert run.voltage_v == pytest.approx(protocol.dynamic[name].voltage_v)
        assert run.mean_percent > protocol.dynamic[name].mean_percent


def test_soc_by_interpolation_lies_by_the_counted_one(protocol):
    soc, e_o = protocol.interpolated
    counted = protocol.dynamic["constant"].soc
    inside = (counted > 0.15) & (counted < 0.95)
    assert np.sqrt(np.mean((soc - counted)[inside] ** 2)) < 0.03
    assert e_o.shape == soc.shape


@pytest.mark.parametrize(
    ("missing", "words"), [("relaxation", "voltage relaxation test"), ("constant", "constant load")]
)
def test_what_is_missing_is_named(samples, missing, words):
    captures = [Capture(name, SERVES[name], block) for name, block in samples.items() if name != missing]
    with pytest.raises(UserError, match=rf"needs a {words}; given: .*steps \(steps\)"):
        Protocol(TRUTH, captures, 1e-3)
