"""Waiting times before the relay is driven again after resets of the board."""

import pytest

from bms_estimator.service.relay_hook import FIRST_HOLD_S, MAX_HOLD_S, QUIET_S, RelayHold


def waiting_times_s(hold: RelayHold, interval_s: float, resets: int) -> list[float]:
    """Return the waiting time after each of several resets at an interval [s]."""
    times_s = []
    for i in range(1, resets + 1):
        assert hold.check(i, i * interval_s) == 1
        times_s.append(hold.hold_s)
    return times_s


@pytest.mark.parametrize(
    ("low_is_safe", "interval_s", "expected_s"),
    [
        (True, 2.0, [30.0, 60.0, 120.0, 240.0, 480.0, 600.0, 600.0]),
        (False, 2.0, [0.0, 30.0, 60.0, 120.0, 240.0, 480.0, 600.0]),
        (True, QUIET_S, [30.0] * 7),
    ],
)
def test_each_reset_without_a_quiet_time_doubles_the_waiting_time(
    low_is_safe: bool, interval_s: float, expected_s: list[float]
) -> None:
    assert waiting_times_s(RelayHold(low_is_safe=low_is_safe), interval_s, 7) == expected_s


@pytest.mark.parametrize(("low_is_safe", "level_while_waiting"), [(True, False), (False, None)])
def test_the_pin_is_not_set_high_while_waiting(low_is_safe: bool, level_while_waiting: bool | None) -> None:
    hold = RelayHold(low_is_safe=low_is_safe)
    assert hold.level(high=True, now_s=0.0) is True
    hold.check(2, 1.0)
    end_s = 1.0 + hold.hold_s
    assert hold.level(high=True, now_s=end_s - 0.1) is level_while_waiting
    assert hold.level(high=False, now_s=1.0) is False
    assert hold.level(high=True, now_s=end_s) is True


@pytest.mark.parametrize("low_is_safe", [True, False])
def test_a_new_alarm_ends_the_waiting_time_only_if_high_is_safe(low_is_safe: bool) -> None:
    hold = RelayHold(low_is_safe=low_is_safe)
    hold.check(10, 1.0)
    hold.end()
    assert hold.level(high=True, now_s=2.0) is (False if low_is_safe else True)  # noqa: SIM211 - level, not condition
    hold.check(11, 3.0)
    assert hold.level(high=True, now_s=3.0 + MAX_HOLD_S - 0.1) is (False if low_is_safe else None)


def test_a_command_must_hold_for_30_s_after_a_single_reset() -> None:
    hold = RelayHold(low_is_safe=False)
    assert hold.is_proven(0.0)
    hold.check(1, 10.0)
    assert not hold.is_proven(9.9 + FIRST_HOLD_S)
    assert hold.is_proven(10.0 + FIRST_HOLD_S)


def test_a_service_that_starts_after_a_failed_hook_waits_as_after_one_reset() -> None:
    hold = RelayHold(low_is_safe=True)
    hold.resume(0.0)
    assert hold.level(high=True, now_s=FIRST_HOLD_S - 0.1) is False
    assert hold.is_proven(0.0)
    hold.check(1, 1.0)
    assert hold.hold_s == 2.0 * FIRST_HOLD_S
