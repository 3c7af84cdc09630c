"""Detection of a device's clock that runs at a wrong rate."""

from collections.abc import Iterable

import numpy as np
import pytest

from bms_estimator.protocols.base.device_clock import DeviceClock

Stamps = Iterable[tuple[float, float]]
"""Arrival time and timestamp of each sample [s]."""


def run(stamps: Stamps) -> tuple[DeviceClock, list[float], list[str]]:
    """Return the clock, the time of each sample and the fault after it."""
    clock, times_s, faults = DeviceClock(), [], []
    for arrival_s, stamp_s in stamps:
        times_s.append(clock.sample_time(float(arrival_s), float(stamp_s)))
        faults.append(clock.fault)
    return clock, times_s, faults


@pytest.mark.parametrize(
    ("rate", "period_s", "detected_s", "words"),
    [
        (0.5, 1, 30, "0.5 times the rate"),
        (0.93, 1, 70, "0.93 times the rate"),
        (2.0, 1, 30, "2 times the rate"),
        (2.0, 10, 30, "2 times the rate"),
        (1.08, 1, 60, "1.08 times the rate"),
        (0.0, 1, 30, "0 times the rate"),
        (1e3, 1, 30, "milliseconds read as seconds: correct the unit"),
        (1e6, 2, 30, "microseconds read as seconds: correct the unit"),
        (1e-3, 1, 30, "seconds read as milliseconds: correct the unit"),
    ],
)
def test_a_wrong_rate_is_detected_and_arrival_times_are_used(
    rate: float, period_s: int, detected_s: int, words: str
) -> None:
    arrivals_s = np.arange(0, 300, period_s)
    clock, times_s, faults = run((100.0 + s, 5.0 + rate * s) for s in arrivals_s)
    assert words in clock.fault
    first = next(i for i, fault in enumerate(faults) if fault)
    assert arrivals_s[first] <= detected_s
    assert np.diff(times_s[first:]) == pytest.approx(period_s)
    if rate < 1.0:
        assert times_s[first:] == pytest.approx(arrivals_s[first:])  # the time jumps forward to the arrival
    # a fault ends when the clock's rate is right again
    clock, _, faults = run([*((s, rate * s) for s in range(100)), *((s, 1e9 + s) for s in range(100, 200))])
    assert (faults[99] != "", clock.fault) == (True, "")


def test_repeated_jumps_are_a_fault_until_they_end():
    jumps_s = [3.0, -3.0] * 500  # 100 s at 10 Hz
    stamps = [(n / 10, n / 10 + offset_s) for n, offset_s in enumerate(jumps_s + [0.0] * 1000)]
    clock, times_s, faults = run(stamps)
    assert faults[299] == ""  # a fault needs three windows of 10 s
    assert "jump again and again" in faults[310]
    assert np.diff(times_s[310:]) == pytest.approx(0.1)
    assert "jump again and again" in faults[999]
    assert clock.fault == ""


def test_two_devices_that_send_to_one_topic_are_a_fault():
    for offset_min in (2, 40, 3600):
        clock, _, _ = run((60 * n, 60 * (n + offset_min * (n % 2))) for n in range(20))
        assert "let only one device send" in clock.fault


RNG = np.random.default_rng(1)
USABLE: dict[str, Stamps] = {
    "drift of 300 ppm": [(s, 1.0003 * s) for s in range(2000)],
    "jitter": [(s + RNG.uniform(0, 3), s) for s in range(5000)],
    "jitter of rare samples": [(s + RNG.uniform(0, 1.5), s) for s in range(0, 50_000, 10)],
    "whole seconds": [(s / 2, int(s / 2)) for s in range(2000)],
    "bursts": [(25 * (s // 25 + 1), s) for s in range(2000)],
    "backlog at once": [(s if s < 200 or s > 500 else 501, s) for s in range(1000)],
    "backlog in half a minute": [(s if s < 200 else 500 + (s - 200) / 11 if s < 530 else s, s) for s in range(1000)],
    "clock set ahead": [(s, s + (3600 if s > 200 else 0)) for s in range(1000)],
    "clock set back": [(s, s - (3600 if s > 200 else 0)) for s in range(1000)],
    "lasting delay": [(s + (6 if s > 200 else 0), s) for s in range(1000)],
    "several outages": [
        (s + (90 if s % 150 > 50 and s % 150 < 60 else 0), s) for s in range(3000) if not 60 < s % 150 < 150
    ],
}


@pytest.mark.parametrize("stamps", USABLE.values(), ids=USABLE)
def test_a_usable_clock_has_no_fault_with_delayed_and_lost_samples(stamps: Stamps) -> None:
    _, _, faults = run(sorted(stamps))
    assert set(faults) == {""}
