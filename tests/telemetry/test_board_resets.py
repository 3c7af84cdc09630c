"""Repeated resets of the sensor board."""

from bms_estimator.telemetry.alarms.causes import RESET_WINDOW_S, RESETS_TEXT, BoardResets


def test_three_resets_within_half_an_hour_are_a_fault_until_the_first_is_half_an_hour_ago() -> None:
    resets = BoardResets()
    assert [resets.update(count, 10.0 * count) for count in range(4)] == ["", "", "", RESETS_TEXT]
    assert resets.update(3, 9.9 + RESET_WINDOW_S) == RESETS_TEXT
    assert resets.update(3, 10.0 + RESET_WINDOW_S) == ""
    assert resets.update(9, 11.0 + RESET_WINDOW_S) == RESETS_TEXT
