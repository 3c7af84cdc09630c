"""The units under a real systemd: installed by the commands of docs/pack/service.md, hardened, killed, starved, uninstalled."""

import os
import re
import shutil

import pytest

from tests.deploy.boot import SECRET, boot, make_root
from tests.deploy.kernel_cache import LEFT_OUT
from tests.patience import LONG_S

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> dict[str, str]:
    """Return the judge's report from inside the container, by the names of its parts."""
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


def test_the_page_s_commands_install_it(report):
    assert "/etc/bms-estimator/pack.toml: good: pack" in report["install"]
    assert "+ journalctl -u bms-estimator -f" in report["install"]


def test_the_service_runs_and_publishes(report):
    assert "ActiveState=active\n" in report["first"], report
    assert "StatusText=estimating pack" in report["first"]
    assert "NRestarts=0" in report["first"]
    assert "never true" not in report["first"]


def test_it_has_no_rights(report):
    assert re.search(r"CapEff:\s+0{16}\n", report["first"]), report
    assert re.search(r"NoNewPrivs:\s+1\n", report["first"])
    assert re.search(r"Seccomp:\s+2\n", report["first"])
    assert not re.search(r"Uid:\s+0\b", report["first"])


def test_it_sees_no_home_and_writes_nothing_beside_its_folders(report):
    assert "/home:\n\n/root:\n" in report["first"]
    assert "'/root/x': Read-only file system" in report["first"]
    assert "'/etc/x': Read-only file system" in report["first"]


def test_it_is_told_which_start_of_the_machine_this_is(report):
    assert re.search(r"^BMS_BOOT_ID=[0-9a-f]{32}$", report["first"], re.MULTILINE), report


def test_kernels_are_compiled_into_the_cache_folder(report):
    assert f"cached {LEFT_OUT}" in report["first"], report


def test_what_the_version_before_has_learned_is_taken_over(report):
    assert '"outcome": "restored: SOC 0.3710"' in report["journal"], report


def test_the_password_of_a_credential_is_read_and_shown_nowhere(report):
    assert '"event": "broker connected"' in report["journal"], report
    assert report["secret"].split() == ["0"] * 4  # journal, environment, ps, health and info


def test_the_watchdog_starts_a_service_that_hangs_and_a_kernel_that_was_cut_is_compiled_again(report):
    assert "never true" not in report["watchdog"], report
    assert "NRestarts=1" in report["watchdog"]
    assert "Watchdog timeout" in report["journal"]
    assert "is damaged" in report["journal"]


def test_it_knows_whether_the_clock_is_set(report):
    """The state of systemd-timesyncd before and after, since the kernel may not be queried; with clock.conf it may."""
    asked = re.findall(r"^clock (-?\d) (\w+)$", report["journal"], re.MULTILINE)
    assert asked[:2] == [("-1", "False"), ("-1", "True")], report
    assert re.fullmatch("[0-5]", asked[2][0]), report


def test_a_second_pack_has_a_unit_of_its_own_and_shares_the_kernels(report):
    assert re.search(r"^StatusText=estimating second.*\n1$", report["second"], re.MULTILINE), report
    assert "/dev/bms/absent" in report["journal"], report


def test_a_full_disk_ends_nothing(report):
    assert "never true" not in report["full"], report
    assert "ActiveState=active" in report["full"]
    assert "No space left on device" in report["journal"]


def test_it_stops_cleanly(report):
    assert "Result=success" in report["second"], report
    assert "Traceback" not in report["journal"]


def test_the_page_s_commands_leave_nothing_behind(report):
    lines = report["uninstall"].splitlines()
    assert [line for line in lines if not line.startswith(("+", "Removed"))] == []
    assert len(lines) > 5
