"""All checks of an installation, in the order of their findings."""

from collections.abc import Iterator
from functools import partial

from bms_estimator.doctor.broker_check import check_broker
from bms_estimator.doctor.check import Check, run_checks
from bms_estimator.doctor.clock_check import check_clock
from bms_estimator.doctor.device_check import FIRST_SAMPLE_S, check_device
from bms_estimator.doctor.disk_check import check_disk
from bms_estimator.doctor.finding import Finding
from bms_estimator.doctor.kernel_check import check_kernels
from bms_estimator.doctor.port_check import check_port
from bms_estimator.doctor.service_check import check_service
from bms_estimator.doctor.settings_check import check_settings
from bms_estimator.doctor.subject import Subject
from bms_estimator.doctor.version_check import check_versions

CLOSING_S = 4.0
"""Time to close a device [s]."""
BROKER_S = 12.0
"""Time within which a broker is examined: connection, subscription, retained messages and echo [s]."""


def examine(subject: Subject | None) -> Iterator[Finding]:
    """Run all checks at the same time, and yield their findings.

    Args:
        subject: Pack and service; None: only the machine is examined, because the settings cannot be read.
    """
    pack_checks: list[Check] = []
    if subject:
        pack_checks = [
            Check("settings", partial(check_settings, subject)),
            Check("port", partial(check_port, subject)),
            Check("device", partial(check_device, subject), FIRST_SAMPLE_S + CLOSING_S),
            Check("broker", partial(check_broker, subject), BROKER_S),
            Check("service", partial(check_service, subject)),
            Check("state folder", partial(check_disk, subject)),
        ]
    machine_checks = [
        Check("kernel cache", partial(check_kernels, subject)),
        Check("clock", partial(check_clock, subject)),
        Check("versions", check_versions),
    ]
    return run_checks([*pack_checks, *machine_checks])
