"""Repeated resets of the sensor board."""

from bms_estimator.telemetry.alarms.board_resets import REASON, WINDOW_S, BoardResets


def test_three_resets_within_half_an_hour_are_a_fault_until_the_first_is_half_an_hour_ago() -> None:
    resets = BoardResets()
    assert [resets.update(count, 10.0 * count) for count in range(4)] == ["", "", "", REASON]
    assert resets.update(3, 9.9 + WINDOW_S) == REASON
    assert resets.update(3, 10.0 + WINDOW_S) == ""
    assert resets.update(9, 11.0 + WINDOW_S) == REASON
