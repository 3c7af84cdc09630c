"""``doctor``: output, exit code and remedies of a whole examination."""

import json
import sys
from pathlib import Path

import pytest

from bms_estimator.cli.settings.doctor import load_examined_settings
from bms_estimator.doctor.finding import Finding
from tests.command_line import run
from tests.doctor.as_user import as_nobody
from tests.mosquitto import Broker

PACK = """\
[pack]
name = "house"
cell = "lfp"
capacity_ah = 20
series = 4
[source]
kind = "mqtt"
url = "{url}"
topic = "bms"
voltage = "v"
current = "i"
interval_s = 0.5
[mqtt]
url = "{url}"
[state]
folder = "{folder}"
"""


def names(findings: list[dict[str, str]], level: str) -> set[str]:
    return {finding["check"] for finding in findings if finding["level"] == level}


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set an empty cache folder, because it takes time to measure a large one."""
    (tmp_path / "cache").mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))


@pytest.fixture
def pack(tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a settings file whose source is silent."""
    monkeypatch.setattr("bms_estimator.doctor.device_check.MIN_FIRST_SAMPLE_TIMEOUT_S", 1.0)
    file = tmp_path / "pack.toml"
    file.write_text(PACK.format(url=broker.url, folder=tmp_path / "state"))
    return file


def test_a_fault_gives_exit_code_1_and_has_a_remedy(capsys: pytest.CaptureFixture[str], pack: Path) -> None:
    code, out, err = run(capsys, "doctor", pack, "--json")
    result = json.loads(out)
    assert (code, err, result["ok"]) == (1, "", False)
    assert names(result["findings"], "fault") == {"device"}
    assert {"settings", "broker", "state folder", "versions"} <= names(result["findings"], "ok")
    assert all(bool(finding["remedy"]) == (finding["level"] != "ok") for finding in result["findings"])


def test_each_finding_is_a_line_and_its_remedy_another(capsys: pytest.CaptureFixture[str], pack: Path) -> None:
    code, out, err = run(capsys, "doctor", pack)
    assert (code, err) == (1, "")
    assert f"ok       settings      {pack}: house: lfp, 4 in series" in out
    lines = out.splitlines()
    (device,) = (number for number, line in enumerate(lines) if line.startswith("fault"))
    assert "no message on bms" in lines[device]
    assert lines[device + 1].strip() == "remedy: check the device and the section [source]"


def test_without_settings_the_machine_is_examined(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bms_estimator.cli.settings.doctor.DEFAULT_PACKS", (tmp_path / "pack.toml",))
    code, out, _ = run(capsys, "doctor", "--json")
    findings = json.loads(out)["findings"]
    assert code == 1
    assert findings[0]["remedy"] == f"bms-estimator new {tmp_path / 'pack.toml'}"
    assert {finding["check"] for finding in findings} == {"settings", "kernel cache", "clock", "versions"}


def test_an_invalid_setting_is_a_finding(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "pack.toml").write_text("[pack]\nsereis = 4\n")
    code, out, err = run(capsys, "doctor", tmp_path / "pack.toml")
    assert (code, err) == (1, "")
    assert "pack.sereis: unknown key; is series meant?" in out
    assert "config check" in out


def test_settings_that_only_root_can_read_need_sudo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "pack.toml"
    tmp_path.chmod(0o755)
    file.touch(mode=0o000)
    monkeypatch.chdir(tmp_path)  # the user nobody has no access to the parents of this folder
    finding = as_nobody(lambda: load_examined_settings(Path("pack.toml")))
    assert isinstance(finding, Finding)
    assert finding.remedy == f"sudo {Path(sys.executable).parent}/bms-estimator doctor pack.toml"


def test_a_long_wait_for_a_sample_is_announced(
    capsys: pytest.CaptureFixture[str], pack: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bms_estimator.cli.settings.doctor.MIN_FIRST_SAMPLE_TIMEOUT_S", 0.5)
    code, _, err = run(capsys, "doctor", pack)
    assert (code, err) == (1, "waiting up to 1 s for a sample of the device\n")
