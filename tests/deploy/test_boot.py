"""Package and service under a real systemd: installed by docs/pack/service.md, tested with faults, upgraded and removed."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.deploy.boot import PROJECT, SECRET, boot, make_root
from tests.deploy.built_version import versions
from tests.patience import LONG_S

PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
NEXT_VERSION = "1000.0.0"
"""Version of the second package, which is higher than that of every checkout."""
NO_USER = "id: bms-estimator: no such user"
BOOT_S = 4 * LONG_S
"""Timeout of the container, which compiles or copies hundreds of MB of Python packages several times [s]."""

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(2 * BOOT_S)]


@pytest.fixture(scope="module")
def report(tmp_path_factory, systemd_nspawn) -> dict[str, str]:
    """Return the parts of the container's report by name."""
    for name in ("mosquitto", "mosquitto_sub"):
        if shutil.which(name, path="/usr/bin:/usr/sbin") is None:
            pytest.skip(f"{name} is not installed (apt install mosquitto mosquitto-clients)")
    packages = tmp_path_factory.mktemp("packages")
    build_package(packages / "current", {})
    build_package(packages / "next", {"SETUPTOOLS_SCM_PRETEND_VERSION": NEXT_VERSION})
    root = tmp_path_factory.mktemp("boot") / "root"
    make_root(root)
    text = boot(root, packages, systemd_nspawn, BOOT_S)
    if "== first" not in text:
        pytest.skip(f"no container boots on this machine: {text[-300:]}")
    assert SECRET not in text
    return dict(re.findall(r"(?ms)^== (\w+)\n(.*?)(?=^== |\Z)", text))


def build_package(folder: Path, variables: dict[str, str]) -> None:
    """Build the wheel and the Debian package in ``folder``, without compression, which would take minutes."""
    if shutil.which("dpkg-deb") is None or not Path("/usr/bin", PYTHON).exists():
        pytest.skip(f"dpkg-deb or /usr/bin/{PYTHON} is missing, as on a distribution other than Debian")
    command = [sys.executable, PROJECT / "deploy/debian/build.py", folder, "--compression", "none"]
    done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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


def test_first_start_compiles_no_kernel(report):
    assert "\ncompiled 0\n" in report["first"], report


def test_checkpoint_of_the_previous_version_is_restored(report):
    assert '"outcome": "restored: SOC 0.3710"' in report["journal"], report


def test_password_is_read_and_never_shown(report):
    assert '"event": "broker connected"' in report["journal"], report
    assert report["secret"].split() == ["0"] * 4  # journal, environment, ps, health and info


def test_watchdog_restarts_a_hung_service(report):
    assert "never true" not in report["watchdog"], report
    assert "NRestarts=1" in report["watchdog"]
    assert "Watchdog timeout" in report["journal"]


def test_service_detects_a_synchronized_clock(report):
    """The first two starts read systemd-timesyncd's file, because the unit forbids to query the kernel. The third has clock.conf."""
    clock_states = re.findall(r"^clock (-?\d) (\w+)$", report["journal"], re.MULTILINE)
    # before and after the file exists; -1: the call is forbidden
    assert clock_states[:2] == [("-1", "False"), ("-1", "True")], report
    assert re.fullmatch("[0-5]", clock_states[2][0]), report


def test_unit_of_a_second_pack_uses_the_same_folder_for_kernels(report):
    assert re.search(r"^StatusText=estimating second.*\n1$", report["second"], re.MULTILINE), report
    assert "/dev/bms/absent" in report["journal"], report


def test_full_disk_does_not_end_the_service(report):
    assert "never true" not in report["full"], report
    assert "ActiveState=active" in report["full"]
    assert "No space left on device" in report["journal"]


def test_service_stops_cleanly(report):
    assert "Result=success" in report["second"], report
    assert "Traceback" not in report["journal"]


@pytest.mark.parametrize("installer", ["deb", "pip"])
def test_upgrade_to_another_version_restarts_the_running_services_with_it(report, installer):
    before, after = report[f"{installer}_before"], report[f"{installer}_after"]
    (version,) = versions(PROJECT, "version")
    assert f"bms-estimator {version}\n" in before, report
    assert f"bms-estimator {NEXT_VERSION}\n" in after, report
    assert messages(before)["info"]["version"] == version
    assert messages(after)["info"]["version"] == NEXT_VERSION
    assert "never true" not in report[installer]
    assert "ActiveState=active" in report[installer]


@pytest.mark.parametrize("installer", ["deb", "pip"])
def test_upgrade_asks_nothing(report, installer):
    """Standard input of the container's script is /dev/null, so that a question would end the upgrade with an error."""
    assert "\nexit code 0\n" in report[installer], report


@pytest.mark.parametrize(
    ("installer", "units"), [("deb", ["enabled", "enabled"]), ("pip", ["disabled", "enabled"])], ids=["deb", "pip"]
)
def test_upgrade_keeps_settings_and_enabled_units_and_rewrites_the_unit(report, installer, units):
    before, after = report[f"{installer}_before"], report[f"{installer}_after"]
    settings = re.findall(r"(?m)^[0-9a-f]{64}  /etc/bms-estimator/\S+$", before)
    assert [line.rpartition("/")[2] for line in settings] == ["mqtt-password", "pack.toml", "second.toml"], report
    assert re.findall(r"(?m)^[0-9a-f]{64}  .+$", after) == settings
    assert [re.findall("(?m)^(?:en|dis)abled$", part) for part in (before, after)] == [units, units], report
    assert "/etc/bms-estimator/pack.toml:1\n/etc/systemd/system/bms-estimator.service:0\n" in report[installer]


@pytest.mark.parametrize("installer", ["deb", "pip"])
def test_upgrade_continues_state_totals_and_history(report, installer):
    before, after = report[f"{installer}_before"], report[f"{installer}_after"]
    old, new = messages(before), messages(after)
    published = re.findall(r"(?m)^published (\S+) (\S+)$", after)
    last_soc = [float(soc) for time, soc in published if time < new["info"]["started"]][-1]
    (restored,) = re.findall(r'"outcome": "restored: SOC ([\d.]+)"', report[installer])
    assert float(restored) == pytest.approx(last_soc, abs=0.01)
    assert new["health"]["restarts"] == old["health"]["restarts"] + 1
    assert new["health"]["total"]["since"] == old["health"]["total"]["since"]
    assert new["health"]["total"]["crashes"] == old["health"]["total"]["crashes"]
    assert new["health"]["total"]["charge_out_ah"] > old["health"]["total"]["charge_out_ah"] > 0.0
    files, events = r"(?m)^/var/lib/bms-estimator/.+$", r"(?m)^\d{4}-.+$"
    assert set(re.findall(files, before)) <= set(re.findall(files, after))
    assert not re.search(r"\.(refused|later)\.", after)
    past = re.findall(events, before)
    assert past
    assert re.findall(events, after)[: len(past)] == past


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
    # root runs the board's simulation, which loads kernels from a cache of its own
    assert "\nRemaining: /root/.cache/bms_estimator\n" in report["uninstall"], report
    assert traces(report["uninstall"]) == [NO_USER]


def messages(part: str) -> dict[str, dict[str, Any]]:
    """Return the messages of the first pack in a part of the report, by the last level of their topics."""
    return {topic: json.loads(text) for topic, text in re.findall(r"(?m)^bms/pack/(\w+) (\{.*\})$", part)}


def traces(part: str) -> list[str]:
    """Return the lines at the end of a part of the report that name files and user of the service, without the order."""
    lines = part.splitlines()
    return [*sorted(line for line in lines[:-1] if re.match(r"[\w-]+ /", line)), lines[-1]]
