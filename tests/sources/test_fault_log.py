"""Logs of the faults of a line, and of the reasons why no samples arrive."""

from structlog.testing import capture_logs

from bms_estimator.sources.fault_log import MAX_REASONS, MIN_LOG_INTERVAL_S, FaultLog, SilenceLog


def logged_reasons(log: SilenceLog, reasons: list[str], begin_s: float = 0.0) -> list[str]:
    """Report one reason a second, and return those that are logged."""
    with capture_logs() as lines:
        for second, reason in enumerate(reasons):
            log.report(reason, begin_s + second)
    return [line["reason"] for line in lines]


def test_alternating_reasons_are_logged_once_each_until_samples_arrive() -> None:
    log = SilenceLog()
    assert logged_reasons(log, ["text", "noise"] * 1000) == ["text", "noise"]
    log.on_samples(2000.0)
    assert logged_reasons(log, ["text", "noise"] * 1000, 2001.0) == ["text", "noise"]


def test_a_reason_that_samples_interrupt_is_logged_at_intervals() -> None:
    log = SilenceLog()
    with capture_logs() as lines:
        for second in range(100):
            log.report("lost", float(second))
            log.on_samples(second + 0.5)
    # each logged silence has one end, and the samples after a silence that was not logged have none
    assert [line["event"] for line in lines] == ["no samples", "samples arrive again"] * int(
        100 // MIN_LOG_INTERVAL_S + 1
    )


def test_reasons_that_always_differ_are_logged_at_intervals() -> None:
    assert (
        MAX_REASONS
        < len(logged_reasons(SilenceLog(), [f"noise {number}" for number in range(1000)]))
        <= MAX_REASONS + 1000 / MIN_LOG_INTERVAL_S
    )


def test_normal_events_are_not_logged_as_faults() -> None:
    log = FaultLog()
    with capture_logs() as lines:
        for second in range(100):
            log.check({"missing": second, "retained": second, "no_number": 0}, float(second))
        log.check({"missing": 100, "retained": 100, "no_number": 1}, 100.0, "current: topic: no number: 'x'")
    assert [(line["event"], line["first"]) for line in lines] == [
        ("faults on the line", "current: topic: no number: 'x'")
    ]
