"""Commands for a pack with a source other than a serial line."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.settings.pack import load_settings
from bms_estimator.sources.captures.replay import RawCapture
from tests.command_line import error, run
from tests.sources.linux.sysfs_folder import hwmon


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    return tmp_path / "pack.toml"


def write_linux_settings(pack: Path) -> Path:
    """Write a pack file with a sensor chip in a simulated folder of /sys: 53.12 V and -2.51 A. Return its path."""
    folder = hwmon(pack.parent / "sys", in1_input=53120, curr1_input=-2510)
    pack.write_text(f'[source]\nkind = "linux"\nchip = "{folder}"\ninterval_s = 0.01\n')
    return pack


def test_chip_of_this_machine_is_recorded_and_replayed(pack, tmp_path, capsys):
    code, out, _ = run(capsys, "config", "check", write_linux_settings(pack))
    assert code == 0
    assert "hwmon3 of this machine; no broker" in out
    raw = tmp_path / "chip.raw"
    code, _, err = run(capsys, "record", raw, "--pack", pack, "--seconds", "0.1")
    assert code == 0, err
    samples = np.concatenate(list(RawCapture(raw)))
    assert samples.size > 1
    assert set(samples["voltage_v"].tolist()) == {53.12}
    assert set(samples["current_a"].tolist()) == {-2.51}


@pytest.mark.parametrize(("command", "options"), [("run", ("--no-view",)), ("record", ("x.raw", "--pack"))])
def test_port_option_is_rejected_without_a_serial_source(command, options, pack, capsys):
    err = error(run(capsys, command, *options, write_linux_settings(pack), "--port", "/dev/ttyACM0"))
    assert "port: applies to a serial device, but [source] in the settings is another device" in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('profile = "opendtu"', "source.url: missing, and there is no section [mqtt] with a broker to use instead"),
        ('profile = "opendtu"\nurl = "mqtt://a"\npassword_file = "/none"', "password_file = /none: cannot be read"),
        ('profile = "opendtu"\nurl = "http://a"', "source.url = 'http://a': must be mqtt://host:port"),
        ('profile = "open"', "source.profile = 'open': "),
        ('profile = "venus"', "source: profile venus: prefix: missing (VRM portal ID"),
        ('topic = "t"\nvoltage = "u"\ncurrent = {unit = "V"}', "source: current.unit = V: must be one of A, mA"),
        ('topic = "t"\nvoltage = "u"\ncurrent = {scle = 2}', "source.current.scle: unknown key"),
        (
            'topic = "t"\nvoltage = "u"\ncurrent = {scale = "2"}',
            "source.current.scale = '2': must be a number, without",
        ),
    ],
)
def test_invalid_source_settings_are_reported(text, message, pack, capsys):
    pack.write_text(f'[source]\nkind = "mqtt"\n{text}\n')
    code, out, err = run(capsys, "config", "check", pack)
    assert (code, out) == (75 if "cannot be read" in message else 2, "")
    assert message in err


def test_output_of_show_with_a_profile_is_read_back(pack, tmp_path, capsys):
    pack.write_text(
        '[source]\nkind = "mqtt"\nprofile = "venus"\nprefix = "c0619ab"\ninstance = "1"\nurl = "mqtt://a"\n'
    )
    code, out, _ = run(capsys, "config", "show", pack)
    assert code == 0
    assert tomllib.loads(out)["source"]["voltage"]["path"] == "value"
    copy = tmp_path / "copy.toml"
    copy.write_text(out)
    assert load_settings(copy) == load_settings(pack)
