"""Units under a real systemd: installed by the commands of docs/pack/service.md, tested with faults, and uninstalled."""

import os
import re
import shutil

import pytest

from tests.deploy.boot import SECRET, boot, make_root
from tests.deploy.kernel_cache import OMITTED
from tests.patience import LONG_S

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
    root = tmp_path_factory.mktemp("boot") / "root"
    make_root(root)
    text = boot(root, systemd_nspawn, LONG_S)
    if "== first" not in text:
        pytest.skip(f"no container boots on this machine: {text[-300:]}")
    assert SECRET not in text
    return dict(re.findall(r"(?ms)^== (\w+)\n(.*?)(?=^== |\Z)", text))


def test_documented_commands_install_the_service(report):
    assert "/etc/bms-estimator/pack.toml: valid; pack" in report["install"]
    assert "+ journalctl -u bms-estimator -f" in report["install"]


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


def test_documented_commands_uninstall_everything(report):
    lines = report["uninstall"].splitlines()
    assert [line for line in lines if not line.startswith(("+", "Removed"))] == []
    assert len(lines) > 5
