"""Arguments of the request ``forecast``."""

from typing import Any

import numpy as np
import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.service.request_handlers import requested_trip


def test_constant_load_is_read_with_its_duration() -> None:
    trip = requested_trip({"power_w": 200, "duration_s": 600})
    assert trip
    assert (trip.load.power_w.tolist(), trip.load.duration_s.tolist(), trip.has_end) == ([200.0], [600.0], True)


def test_constant_load_without_a_duration_has_no_end() -> None:
    trip = requested_trip({"current_a": 2.5})
    assert trip
    assert (trip.load.current_a.tolist(), trip.has_end) == ([2.5], False)


def test_profiles_are_read_by_their_quantity() -> None:
    points = [[0, 100], [60, 0], [90, 0]]
    power, current = requested_trip({"profile": points}), requested_trip({"current_profile": points})
    assert power
    assert current
    assert power.load.power_w.tolist() == current.load.current_a.tolist() == [100.0, 0.0]
    assert np.isnan(current.load.power_w).all()


def test_without_a_load_the_observed_one_is_used() -> None:
    assert requested_trip({"transaction": 1}) is None


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"power_w": 1, "current_a": 2}, "power_w and current_a: give one of them"),
        ({"power_w": 1, "profile": []}, "power_w and profile: give one of them"),
        ({"power_w": "1"}, "power_w = '1': must be a number"),
        ({"power_w": True}, "power_w = True: must be a number"),
        ({"power_w": 1e9}, "must be a number from -1e+06 to 1e+06"),
        ({"power_w": 1, "duration_s": -5}, "duration_s = -5: must be a number"),
        ({"power_w": 1, "duration_s": 0}, "duration_s = 0: must be above 0"),
        ({"duration_s": 5}, "duration_s: belongs to power_w or current_a"),
        ({"profile": [[0, 1], [1, 1]], "duration_s": 5}, "duration_s: belongs to"),
        ({"profile": {"0": 1}}, "profile: must be a list of pairs [time_s, power_w]"),
        ({"current_profile": [[0, 1], [1]]}, "current_profile: must be a list of pairs [time_s, current_a]"),
        ({"profile": [[0, 1], [1, None]]}, "profile: must be a list of pairs"),
        ({"profile": [[0, 10**400], [1, 1]]}, "profile: must be a list of pairs"),
        ({"profile": []}, "profile: 0 points"),
        ({"profile": [[0, 1], [0, 1]]}, "profile: point 2: time_s = 0 after 0: must increase"),
    ],
)
def test_invalid_arguments_are_rejected(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(UserError) as caught:
        requested_trip(arguments)
    assert text in str(caught.value)
