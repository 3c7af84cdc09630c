"""Runner of checks: order of the findings, exceptions, checks that hang."""

import threading
from collections.abc import Iterator

import pytest

from bms_estimator.doctor.examine import Check, run_checks
from bms_estimator.doctor.finding import Finding, Level, ok
from bms_estimator.model.errors import UserError
from tests.patience import LONG_S


def succeed() -> Iterator[Finding]:
    yield ok("good", "fine")


def raise_after_a_finding(error: Exception) -> Iterator[Finding]:
    yield ok("bad", "begun")
    raise error


def test_findings_are_in_the_order_of_the_checks() -> None:
    first_may_end = threading.Event()

    def end_last() -> Iterator[Finding]:
        assert first_may_end.wait(60.0)
        yield ok("first", "")

    def end_first() -> Iterator[Finding]:
        yield ok("second", "")
        first_may_end.set()

    checks = [Check("first", end_last, timeout_s=60.0), Check("second", end_first, timeout_s=60.0)]
    assert [finding.check for finding in run_checks(checks)] == ["first", "second"]


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ValueError("strange"), "the check itself failed: ValueError: strange"),
        (UserError("mqtt.url: wrong"), "mqtt.url: wrong"),
        (ModuleNotFoundError("No module named 'can'", name="can"), "the package can is not installed"),
    ],
)
def test_a_check_that_raises_is_a_fault_and_the_others_run(error: Exception, text: str) -> None:
    checks = [Check("bad", lambda: raise_after_a_finding(error)), Check("good", succeed)]
    begun, failed, good = run_checks(checks)
    assert (begun.level, failed.level, good.level) == (Level.OK, Level.FAULT, Level.OK)
    assert failed.check == "bad"
    assert failed.text == text
    assert failed.remedy


def test_a_check_that_hangs_is_a_warning_and_the_others_run() -> None:
    has_begun, forever = threading.Event(), threading.Event()

    def hang() -> Iterator[Finding]:
        yield ok("slow", "begun")
        has_begun.set()
        forever.wait()

    begun, hung, good = run_checks(
        [
            # without a finding if the slow check has begun, so that its time limit is checked afterwards
            Check("waits for the slow check", lambda: [] if has_begun.wait(LONG_S) else succeed(), timeout_s=LONG_S),
            Check("slow", hang, timeout_s=0.2),
            Check("good", succeed),
        ]
    )
    forever.set()
    assert (hung.check, hung.level, hung.text) == ("slow", Level.WARNING, "no result within 0.2 s")
    assert (begun.text, good) == ("begun", ok("good", "fine"))
