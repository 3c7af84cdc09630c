"""A little of ``make load``: the line itself has tests of its own."""

from tests.benchmarks.endurance import fed


def test_ten_minutes_of_serial_bytes_are_all_estimated() -> None:
    dialect, estimator, _, _ = fed(100, 600.0)
    assert dialect.counters["frames_received"] == estimator.state["samples"][0] == 60_000
    assert dialect.counters["frames_lost"] == dialect.counters["clock_jumps"] == 0
