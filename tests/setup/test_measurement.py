"""Measurement of the present voltage and current."""

import math

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import Settings
from bms_estimator.setup import measurement
from bms_estimator.setup.first_estimate import current_note
from tests.scripted_source import ScriptedSource


@pytest.fixture
def source(monkeypatch) -> ScriptedSource:
    scripted = ScriptedSource()
    monkeypatch.setattr(measurement, "open_source", lambda _: scripted)
    return scripted


async def test_samples_without_voltage_or_current_are_ignored(source) -> None:
    source.give((0.0, 1.0, 13.0), (1.0, math.nan, 13.0), (2.0, 1.0, math.nan), (3.0, 3.0, 15.0))
    source.finish()
    assert await measurement.measure(Settings()) == measurement.Measurement(14.0, 2.0)


async def test_a_device_without_valid_values_is_an_error(source) -> None:
    source.give((0.0, math.nan, 13.0), (1.0, 1.0, math.nan))
    source.finish()
    with pytest.raises(UserError, match="no valid voltage and current"):
        await measurement.measure(Settings())


@pytest.mark.parametrize(("current_a", "is_noted"), [(10.0, False), (10.5, True), (-10.5, True)])
def test_a_current_above_a_tenth_of_the_capacity_is_noted(current_a: float, is_noted: bool) -> None:
    assert bool(current_note(current_a, 100.0)) is is_noted
