"""Comparison with a multimeter: gains, sign and zero, and comparisons that are rejected."""

import pytest

from bms_estimator.setup.answers import InvalidAnswerError
from bms_estimator.setup.multimeter import VoltagePoint, current_correction, require_zero, voltage_gain


def test_one_comparison_gives_the_gain_of_the_voltage() -> None:
    assert voltage_gain([VoltagePoint(13.0, 13.26)]) == pytest.approx(1.02)


def test_the_gain_of_two_comparisons_is_between_them() -> None:
    assert 1.020 < voltage_gain([VoltagePoint(13.0, 13.26), VoltagePoint(12.0, 12.264)]) < 1.022


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([VoltagePoint(13.0, 3.3)], "terminals of this pack"),
        ([VoltagePoint(13.0, -13.0)], "terminals of this pack"),
        ([VoltagePoint(13.0, 13.0), VoltagePoint(12.0, 12.5)], "comparisons disagree by"),
    ],
)
def test_an_implausible_voltage_is_rejected(points: list[VoltagePoint], reason: str) -> None:
    with pytest.raises(InvalidAnswerError, match=reason):
        voltage_gain(points)


def test_opposite_currents_reverse_the_sign() -> None:
    correction = current_correction(-4.0, 5.0)
    assert (correction.gain, correction.is_sign_wrong) == (pytest.approx(1.25), True)
    assert not current_correction(-4.0, -5.0).is_sign_wrong


@pytest.mark.parametrize(
    ("device_a", "multimeter_a", "resolution_a", "reason"),
    [
        (0.1, 0.1, 0.0, "at least 0.2 A; switch on a larger load"),
        (1.5, 1.5, 0.1, "at least 2 A"),
        (4.0, 8.0, 0.0, "does all current flow through both"),
    ],
)
def test_a_current_that_cannot_be_compared_is_rejected(
    device_a: float, multimeter_a: float, resolution_a: float, reason: str
) -> None:
    with pytest.raises(InvalidAnswerError, match=reason):
        current_correction(device_a, multimeter_a, resolution_a=resolution_a)


def test_a_large_current_is_rejected_as_zero() -> None:
    assert require_zero(-0.3) == -0.3
    with pytest.raises(InvalidAnswerError, match="everything switched off"):
        require_zero(3.0)
