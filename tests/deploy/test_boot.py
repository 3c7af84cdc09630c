"""Package and service under a real systemd: installed by docs/pack/service.md, tested with faults, upgraded and removed."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.deploy.boot import PROJECT, SECRET, boot, make_root
from tests.deploy.kernel_cache import OMITTED
from tests.patience import LONG_S

PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
NO_USER = "id: bms-estimator: no such user"

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> dict[str, str]:
    """Return the parts of the container's report by name."""
    systemd_nspawn = "/usr/bin/systemd-nspawn"
    if not os.access(systemd_nspawn, os.X_OK):
        pytest.skip("systemd-nspawn is not installed (apt install systemd-container)")
    if os.geteuid() != 0:
        pytest.skip("only root can boot a container")
    for name in ("mosquitto", "mosquitto_sub"):
        if shutil.which(name, path="/usr/bin:/usr/sbin") is None:
            pytest.skip(f"{name} is not installed (apt install mosquitto mosquitto-clients)")
    package = build_package(tmp_path_factory.mktemp("deb") / "deb")
    root = tmp_path_factory.mktemp("boot") / "root"
    make_root(root)
    text = boot(root, package, systemd_nspawn, LONG_S)
    if "== first" not in text:
        pytest.skip(f"no container boots on this machine: {text[-300:]}")
    assert SECRET not in text
    return dict(re.findall(r"(?ms)^== (\w+)\n(.*?)(?=^== |\Z)", text))


def build_package(folder: Path) -> Path:
    """Build the Debian package, without compression, which would take minutes. Return its path."""
    if shutil.which("dpkg-deb") is None or not Path("/usr/bin", PYTHON).exists():
        pytest.skip(f"dpkg-deb or /usr/bin/{PYTHON} is missing, as on a distribution other than Debian")
    command = [sys.executable, PROJECT / "deploy/debian/build.py", folder, "--compression", "none"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.splitlines()[-1])


def test_package_is_not_started_without_settings(report):
    assert "The service starts when it has settings" in report["install"], report
    assert "The service starts when it has settings" in report["install"].partition("bms-estimator install")[0]


def test_documented_commands_install_the_service(report):
    assert "pack.toml: valid; pack" in report["install"]
    assert re.search(r"^service +started$", report["install"], re.MULTILINE), report
    assert "\nenabled\n" in report["first"]


def test_the_service_runs_and_publishes(report):
    assert "ActiveState=active\n" in report["first"], report
    assert "StatusText=estimating pack" in report["first"]
    assert "NRestarts=0" in report["first"]
    assert "never true" not in report["first"]


def test_service_has_no_privileges(report):
    assert re.search(r"CapEff:\s+0{16}\n", report["first"]), report
    assert re.search(r"NoNewPrivs:\s+1\n", report["first"])
    assert re.search(r"Seccomp:\s+2\n", report["first"])
    assert not re.search(r"Uid:\s+0\b", report["first"])


def test_service_sees_no_home_and_writes_only_its_folders(report):
    assert "/home:\n\n/root:\n" in report["first"]
    assert "'/root/x': Read-only file system" in report["first"]
    assert "'/etc/x': Read-only file system" in report["first"]


def test_unit_passes_the_boot_id_to_the_service(report):
    assert re.search(r"^BMS_BOOT_ID=[0-9a-f]{32}$", report["first"], re.MULTILINE), report


def test_missing_kernel_is_compiled_into_the_cache_folder_of_the_unit(report):
    assert f"cached {OMITTED}" in report["first"], report


def test_checkpoint_of_the_previous_version_is_restored(report):
    assert '"outcome": "restored: SOC 0.3710"' in report["journal"], report


def test_password_is_read_and_never_shown(report):
    assert '"event": "broker connected"' in report["journal"], report
    assert report["secret"].split() == ["0"] * 4  # journal, environment, ps, health and info


def test_watchdog_restarts_a_hung_service_and_truncated_kernels_are_recompiled(report):
    assert "never true" not in report["watchdog"], report
    assert "NRestarts=1" in report["watchdog"]
    assert "Watchdog timeout" in report["journal"]
    assert "is damaged" in report["journal"]


def test_service_detects_a_synchronized_clock(report):
    """The first two starts read systemd-timesyncd's file, because the unit forbids to query the kernel. The third has clock.conf."""
    clock_states = re.findall(r"^clock (-?\d) (\w+)$", report["journal"], re.MULTILINE)
    # before and after the file exists; -1: the call is forbidden
    assert clock_states[:2] == [("-1", "False"), ("-1", "True")], report
    assert re.fullmatch("[0-5]", clock_states[2][0]), report


def test_unit_of_a_second_pack_uses_the_same_cached_kernels(report):
    assert re.search(r"^StatusText=estimating second.*\n1$", report["second"], re.MULTILINE), report
    assert "/dev/bms/absent" in report["journal"], report


def test_full_disk_does_not_end_the_service(report):
    assert "never true" not in report["full"], report
    assert "ActiveState=active" in report["full"]
    assert "No space left on device" in report["journal"]


def test_service_stops_cleanly(report):
    assert "Result=success" in report["second"], report
    assert "Traceback" not in report["journal"]


def test_upgrade_keeps_settings_and_state_and_restarts_the_service(report):
    assert "never true" not in report["upgrade"], report
    assert "\n# edited\n" in report["upgrade"]
    assert "ActiveState=active" in report["upgrade"]
    assert '"outcome": "restored: SOC' in report["upgrade"]


def test_removal_of_the_package_keeps_settings_and_state_of_root(report):
    assert "Remaining: " in report["remove"], report
    assert traces(report["remove"]) == [
        "root /etc/bms-estimator",
        "root /etc/systemd/system/bms-estimator.service.d",
        "root /etc/systemd/system/bms-estimator@.service.d",
        "root /var/lib/bms-estimator",
        NO_USER,
    ]


def test_purge_of_the_package_leaves_nothing(report):
    assert traces(report["purge"]) == [NO_USER]


def test_program_in_a_home_folder_is_copied_and_its_service_runs(report):
    assert "copying the program to /opt/bms-estimator" in report["home"], report
    assert "ActiveState=active" in report["home"]
    assert "path=/opt/bms-estimator/bin/bms-estimator ;" in report["home"]


def test_uninstall_with_purge_also_removes_the_copy(report):
    assert "Remaining: nothing" in report["home"], report
    assert traces(report["home"]) == [NO_USER]


def traces(part: str) -> list[str]:
    """Return the lines at the end of a part of the report that name files and user of the service, without the order."""
    lines = part.splitlines()
    return [*sorted(line for line in lines[:-1] if re.match(r"[\w-]+ /", line)), lines[-1]]
