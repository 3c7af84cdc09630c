"""The unit under a real systemd: hardened, kernels compiled, cached, started again, stopped."""

import os
import re

import pytest

from tests.deploy.boot import boot, make_root
from tests.deploy.kernel_cache import LEFT_OUT
from tests.patience import LONG_S


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> str:
    """What the judge inside the container saw."""
    systemd_nspawn = "/usr/bin/systemd-nspawn"
    if not os.access(systemd_nspawn, os.X_OK):
        pytest.skip("systemd-nspawn is not installed (apt install systemd-container)")
    if os.geteuid() != 0:
        pytest.skip("only root can boot a container")
    root = tmp_path_factory.mktemp("boot") / "root"
    make_root(root)
    text = boot(root, systemd_nspawn, LONG_S)
    if "ActiveState" not in text:
        pytest.skip(f"no container boots on this machine: {text[-300:]}")
    return text


def test_the_service_runs(report):
    assert "ActiveState=active\n" in report, report
    assert "StatusText=estimating pack" in report
    assert "NRestarts=0" in report


def test_it_has_no_rights(report):
    assert re.search(r"CapEff:\s+0{16}\n", report), report
    assert re.search(r"NoNewPrivs:\s+1\n", report)
    assert re.search(r"Seccomp:\s+2\n", report)
    assert not re.search(r"Uid:\s+0\b", report)


def test_it_is_told_which_start_of_the_machine_this_is(report):
    assert re.search(r"^BMS_BOOT_ID=[0-9a-f]{32}$", report, re.MULTILINE), report


def test_it_can_ask_whether_the_clock_is_set(report):
    assert re.search(r"^adjtimex [0-5]$", report, re.MULTILINE), report


def test_a_second_pack_has_a_unit_of_its_own_and_shares_the_kernels(report):
    _, _, second = report.partition("StatusText=estimating second")
    assert re.match(r"[^\n]*\n1\n", second), report


def test_kernels_are_compiled_into_the_cache_folder(report):
    assert f"cached {LEFT_OUT}" in report, report


def test_it_says_that_the_board_is_missing(report):
    assert "/dev/bms/absent" in report, report


def test_it_stops_cleanly(report):
    assert report.count("Result=success") == 2, report
    assert "Traceback" not in report
