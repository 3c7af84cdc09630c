"""All checks of an installation, in the order of their findings. A check that hangs or raises is itself a finding."""

import os
import platform
import shlex
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path

from bms_estimator.doctor.broker_check import check_broker
from bms_estimator.doctor.device_check import CELLS_TIMEOUT_S, check_device, first_sample_timeout_s
from bms_estimator.doctor.finding import ExaminedPack, Finding, fault, ok, warning
from bms_estimator.doctor.kernel_check import check_kernels
from bms_estimator.doctor.port_check import check_port
from bms_estimator.doctor.service_check import check_service
from bms_estimator.installation import paths
from bms_estimator.installation.machine import root_command
from bms_estimator.model.errors import UserError
from bms_estimator.process.boot_timestamp import TIMESYNCD, is_clock_synchronized
from bms_estimator.service import pack_check
from bms_estimator.version import __version__


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


SETTINGS = "settings"


def check_settings(subject: ExaminedPack) -> Iterator[Finding]:
    """Yield a summary of the settings, and each likely mistake.

    Raises:
        UserError: A setting cannot be used.
    """
    warnings = pack_check.check_settings(subject.settings, subject.model)
    yield ok(SETTINGS, f"{subject.path}: {pack_check.summarize(subject.settings, subject.model)}")
    for text in warnings:
        yield warning(SETTINGS, text, f"edit {subject.path}, then: bms-estimator config check {subject.path}")


DISK = "state folder"
HISTORY_MB_PER_DAY = 0.2
"""Size of the history of a day [MB]: 72 MB a year."""
CHECKPOINTS_MB = 10.0
"""Size of checkpoints, temporary files and the queue of a short outage [MB]."""


def check_disk(subject: ExaminedPack) -> Iterator[Finding]:
    """Yield findings on the permissions of the state folder, and on the disk space for the history."""
    folder = subject.state_folder
    existing = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
    if not os.access(existing, os.R_OK | os.W_OK | os.X_OK):
        if subject.unit:  # the folder belongs to the service's user
            yield warning(DISK, f"{folder}: cannot be read by this user; not checked", subject.command_as_root)
        else:
            remedy = f"let this user write it: sudo chown {os.geteuid()} {existing}; or set state.folder"
            yield fault(DISK, f"{existing}: this user may not write it", remedy)
        return
    free_mb = shutil.disk_usage(existing).free / 1e6
    used_mb = sum(file.stat().st_size for file in folder.glob("*") if file.is_file()) / 1e6
    needed_mb = CHECKPOINTS_MB + max(HISTORY_MB_PER_DAY * subject.settings.store.history_days - used_mb, 0.0)
    text = f"{folder}: {used_mb:.0f} MB used, {free_mb:,.0f} MB free"
    if free_mb < CHECKPOINTS_MB:
        yield fault(DISK, f"{text}: the disk is full", f"free some space: sudo du -xh {existing} | sort -h | tail")
    elif free_mb < needed_mb:
        text += f", but a history of {subject.settings.store.history_days} days needs {needed_mb:,.0f} MB"
        yield warning(DISK, text, "free some space, or set a smaller store.history_days")
    else:
        yield ok(DISK, text)


PACKAGES = ("numba", "numpy", "aiomqtt", "pydantic", "pyserial")
"""Packages whose versions are reported."""


def check_versions() -> Iterator[Finding]:
    """Yield the versions."""
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    yield ok("versions", f"bms-estimator {__version__}, Python {platform.python_version()}, {packages}, {system}")


CLOCK = "clock"
REAL_TIME_CLOCK = Path("/dev/rtc0")
"""Clock with a battery."""


def check_clock(subject: ExaminedPack | None) -> Iterator[Finding]:
    """Yield findings on the synchronization of the clock, and on the service's access to its state."""
    hardware = "a clock with a battery" if REAL_TIME_CLOCK.exists() else "no clock with a battery"
    if is_clock_synchronized():
        yield ok(CLOCK, f"synchronized; {hardware}")
    else:
        text = f"not synchronized; {hardware}: the length of a power-off counts as unknown"
        yield warning(CLOCK, text, "sudo timedatectl set-ntp true; in a container: synchronize the host")
    if subject and subject.unit and is_clock_synchronized() and not TIMESYNCD.exists():
        drop_in = paths.clock_drop_in(paths.TEMPLATE if "@" in subject.unit.name else paths.UNIT)
        if not drop_in.exists():
            text = "the service cannot see that the clock is synchronized, because systemd-timesyncd does not run"
            yield warning(CLOCK, text, f"{shlex.join(root_command('install'))}, which adds {drop_in.name} to the unit")


CLOSING_S = 4.0
"""Time that is allowed for closing a device [s]."""
BROKER_TIMEOUT_S = 12.0
"""Timeout of the check of a broker: connection, subscription, retained messages and echo [s]."""


def examine(subject: ExaminedPack | None) -> Iterator[Finding]:
    """Run all checks at the same time, and yield their findings.

    Args:
        subject: Pack and service; None: only the machine is examined, because the settings cannot be read.
    """
    pack_checks: list[Check] = []
    if subject:
        pack_checks = [
            Check("settings", partial(check_settings, subject)),
            Check("port", partial(check_port, subject)),
            Check(
                "device",
                partial(check_device, subject),
                first_sample_timeout_s(subject.settings) + CELLS_TIMEOUT_S + CLOSING_S,
            ),
            Check("broker", partial(check_broker, subject), BROKER_TIMEOUT_S),
            Check("service", partial(check_service, subject)),
            Check("state folder", partial(check_disk, subject)),
        ]
    machine_checks = [
        Check("kernel cache", partial(check_kernels, subject)),
        Check("clock", partial(check_clock, subject)),
        Check("versions", check_versions),
    ]
    return run_checks([*pack_checks, *machine_checks])
