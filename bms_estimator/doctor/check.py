"""Runner of checks. A check that hangs or raises is itself a finding."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from bms_estimator.doctor.finding import Finding, fault, warning
from bms_estimator.model.errors import UserError


@dataclass
class Check:
    """Check that runs in its own thread, which ends with the process if the check hangs."""

    name: str
    run: Callable[[], Iterable[Finding]]
    timeout_s: float = 5.0
    """Time after which the check counts as hung [s]."""
    findings: list[Finding] = field(default_factory=list)
    """Findings so far."""


def run_checks(checks: Sequence[Check]) -> Iterator[Finding]:
    """Run all checks at the same time, and yield their findings in the order of ``checks``."""
    started_s = time.monotonic()
    threads = [threading.Thread(target=_run, args=(check,), name=check.name, daemon=True) for check in checks]
    for thread in threads:
        thread.start()
    for check, thread in zip(checks, threads, strict=True):
        thread.join(max(started_s + check.timeout_s - time.monotonic(), 0.0))
        yield from list(check.findings)
        if thread.is_alive():
            text = f"no result within {check.timeout_s:g} s"
            yield warning(check.name, text, "run the command again; if it happens again, report it as a bug")


def _run(check: Check) -> None:
    """Collect the findings of a check. An exception becomes a finding."""
    try:
        for finding in check.run():
            check.findings.append(finding)
    except UserError as error:
        text, remedy = str(error), "correct the settings: bms-estimator config check"
        check.findings.append(fault(check.name, text, remedy))
    except ModuleNotFoundError as error:
        text, remedy = (
            f"the package {error.name} is not installed",
            "read how to install it: bms-estimator config check",
        )
        check.findings.append(fault(check.name, text, remedy))
    except Exception as error:  # noqa: BLE001 - reported as a finding
        text = f"the check itself failed: {type(error).__name__}: {error}"
        check.findings.append(fault(check.name, text, "report this as a bug, with the output of this command"))
