"""Udev rule, read by udev."""

import os
import subprocess
from pathlib import Path

import pytest

from bms_estimator.installation.install import FILES

# Mounts an empty /run/udev, copies the rules ($1) there, and lets udevadm ($2) test a device ($3). It runs in a mount
# namespace of its own, which ends with the shell.
READ_RULES_SCRIPT = (
    'mount -t tmpfs none /run/udev && mkdir /run/udev/rules.d && cp "$1" /run/udev/rules.d/ && exec "$2" test "$3"'
)


def messages_about(find_program, rules: Path) -> list[str]:
    """Return udev's messages about a file of rules."""
    udevadm, unshare = find_program("udevadm", "udev"), find_program("unshare", "util-linux")
    if os.geteuid() != 0:
        pytest.skip("only root can give udev a folder of rules for a test")
    device = next(Path("/sys/class/tty").iterdir(), None)
    if device is None or subprocess.run([unshare, "--mount", "true"], capture_output=True, check=False).returncode:
        pytest.skip("this machine has no tty devices or allows no mount namespaces")
    Path("/run/udev").mkdir(exist_ok=True)  # the mount point must exist
    command = [unshare, "--mount", "sh", "-c", READ_RULES_SCRIPT, "sh", str(rules), udevadm, str(device)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = (done.stdout + done.stderr).splitlines()
    messages = [line for line in lines if rules.name in line]
    assert any(line.startswith("Reading rules file") for line in messages), lines
    return [line for line in messages if not line.startswith("Reading rules file")]


def test_udev_reports_no_error_in_the_rule(find_program):
    assert messages_about(find_program, FILES / "99-bms-estimator.rules") == []


def test_udev_reports_a_misspelled_key(find_program, tmp_path):
    rules = tmp_path / "99-wrong.rules"
    rules.write_text('SUBSISTEM=="tty", SYMLINK+="bms"\n')
    assert any("SUBSISTEM" in line for line in messages_about(find_program, rules))
