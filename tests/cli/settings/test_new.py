"""``new``: the wizard finds the device, asks, compares with a multimeter, writes the file and shows the first estimate."""

import asyncio
import math
import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread
from urllib.parse import quote

import pytest

from bms_estimator.cli.settings.new import _place_kinds, _places
from bms_estimator.cli.settings.prompts import Prompts
from bms_estimator.protocols.firmware.messages import Hello
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.observer import ChargeLimits
from bms_estimator.settings.pack import load_settings
from bms_estimator.setup.search import DEFAULT_BROKER
from bms_estimator.simulation.esphome_node import SimulatedNode
from bms_estimator.simulation.simulated_pack import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.serial.device_detection import BoardClient
from tests.command_line import PROGRAM, error, run
from tests.device_line import running_device
from tests.mosquitto import PASSWORD, Broker, password_broker
from tests.patience import LONG_S
from tests.pseudo_terminal import PseudoTerminal
from tests.simavr_board import SimavrBoard, write_readings

ESTIMATE = re.compile(r"26\.66 V, 5\.50 A; the SOC is not known yet")
ANSWERS = {
    "--name": "house",
    "--cell": "lfp",
    "--capacity-ah": "100",
    "--series": "8",
    "--parallel": "1",
    "--full-voltage-v": "none",
    "--cutoff-voltage-v": "none",
    "--max-discharge-a": "60",
    "--max-charge-a": "none",
    "--device-soc-std": "none",
    "--broker": "none",
}
"""Answers about a pack of eight cells."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "pack.toml"


@pytest.fixture
def long_timeouts(monkeypatch):
    """Lengthen the timeouts for a JK-BMS. Shorten the wait for a board, because none is connected."""
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.BOOT_TIMEOUT_S", 0.1)
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.PROTOCOL_TIMEOUT_S", LONG_S)
    monkeypatch.setattr("bms_estimator.setup.measurement.FIRST_SAMPLE_TIMEOUT_S", LONG_S)
    monkeypatch.setattr("bms_estimator.setup.measurement.AVERAGE_S", 0.1)


@pytest.fixture
def patient_probe(monkeypatch):
    """Lengthen the timeout of a board, whose simulation is slow on a busy machine."""
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.BOOT_TIMEOUT_S", LONG_S)


def jk_bms(current_a: float = 5.0) -> SimulatedBms:
    return SimulatedBms("jk", lambda _: Reading(current_a, 26.4, 21.0), cells=8)


def options(**changes: str | None) -> list[str]:
    """Return the options of ``ANSWERS`` with changes; None removes an option."""
    given = ANSWERS | {f"--{name.replace('_', '-')}": value for name, value in changes.items()}
    return [text for name, value in given.items() if value is not None for text in (name, value)]


def dialog(path: str) -> list[tuple[str, str, str]]:
    """Return questions, answers and replies of a session in which each kind of wrong answer occurs."""
    return [
        ("Where to search", path, f"searching {path}: up to 20 s"),
        ("Number of the device", "7", "7: was not found"),
        ("Number of the device", "/dev/none", "-  /dev/none: cannot be opened: No such file or directory\n"),
        ("Number of the device", "mqtt://localhost:99999", "Port out of range"),
        ("Number of the device", "", "measured: 26.40 V, 5.00 A, discharging"),
        ("Compare the device with a multimeter", "maybe", "maybe: must be y or n"),
        ("Compare the device with a multimeter", "y", "Press Enter without a value to skip a step"),
        ("Voltage at the terminals", "2.6", "which differs by more than 20%"),
        ("Voltage at the terminals", "26,664 V", "voltage: device 26.400 V, multimeter 26.664 V: gain 1.0100"),
        ("Voltage again", "", "Switch off all loads"),
        ("Switch off all loads", "x", "x: must be 0"),
        ("Switch off all loads", "0", "is everything switched off?"),
        ("Switch off all loads", "", "Switch on a load"),
        ("Switch on a load", "0.1", "switch on a larger load"),
        ("Switch on a load", "5.5", "gain 1.1000"),
        ("Name of the pack", "my pack", "my pack: is not of the form that it must have (name of the pack"),
        ("Name of the pack", "house", "lfp  LFP, LiFePO4"),
        ("Chemistry of the cells", "", "an answer is required"),
        ("Chemistry of the cells", "lead", "lead: must be one of"),
        ("Chemistry of the cells", "LiFePO4", "Capacity of one cell"),
        ("Capacity of one cell", "100000", "is it in mAh?"),
        ("Capacity of one cell", "-100", "-100.0: must be greater than 0"),
        ("Capacity of one cell", "much", "much: must be a number, such as 12 Ah"),
        ("Capacity of one cell", "40 Ah", "Cells in series"),
        ("Cells in series", "4", "4: the device reports 8 cells in series"),
        ("Cells in series", "", "Cells in parallel"),
        ("Cells in parallel", "1.5", "1.5: must be a whole number"),
        ("Cells in parallel", "", "The SOC is 100 %"),
        (
            "Voltage of the pack at which its charger stops",
            "3.5",
            "3.5: must be 26.36 to 31.2 V, the voltage of 8 lfp cells",
        ),
        ("Voltage of the pack at which its charger stops [^[]*\\[V\\] \\[28\\]", "", "This is 0 %"),
        ("Voltage of the pack at which its BMS ends", "23", "Largest discharge current"),
        ("Largest discharge current", "-5", "-5.0: must be greater than 0"),
        ("Largest discharge current", "60 A", "Largest charge current"),
        ("Largest charge current", "", "How far may the SOC of the device be wrong"),
        ("How far may the SOC of the device be wrong", "", "MQTT broker"),
        ("MQTT broker", "localhost", "localhost: must be mqtt://host:port"),
        ("MQTT broker", "mqtt://localhost:99999", "mqtt://localhost:99999: Port out of range 0-65535"),
        ("MQTT broker", "none", "pack.toml: written; house: lfp, 8 in series"),
        ("Install the service", "n", "; live page: http://127.0.0.1:"),
    ]


def test_wizard_asks_again_after_wrong_answers_and_writes_the_file(file):
    with running_device(jk_bms()) as path, PseudoTerminal("new", str(file), columns=200) as terminal:
        for question, answer, reply in dialog(path):
            terminal.until(lambda question=question: re.search(f"{question}[^\n]*[:?] $", plain(terminal.output)))
            terminal.output = ""
            terminal.press(f"{answer}\r".encode())
            terminal.until(lambda reply=reply: reply in plain(terminal.output))
            if reply.startswith("pack.toml"):
                terminal.until(lambda: ESTIMATE.search(plain(terminal.output)))
                terminal.until(lambda: "estimate under load is inexact" in plain(terminal.output))
        terminal.until(terminal.ended)
    assert terminal.process.returncode == 0
    assert tomllib.loads(file.read_text())["pack"]["name"] == "house"
    settings = load_settings(file)
    assert (settings.pack.cell, settings.pack.capacity_ah, settings.pack.series) == ("lfp", 40.0, 8)
    assert (settings.pack.max_discharge_a, settings.pack.max_charge_a) == (60.0, None)
    assert settings.charge_limits == ChargeLimits(full_voltage_v=28.0, cutoff_voltage_v=23.0)
    assert settings.pack.device_soc_std == 0.1
    assert (settings.sensor.port, settings.sensor.protocol, settings.mqtt) == (path, "jk", None)
    assert (settings.sensor.voltage_gain, settings.sensor.current_gain) == (pytest.approx(1.01), pytest.approx(1.1))


@pytest.mark.thorough
def test_an_interrupt_at_a_prompt_ends_with_code_130_and_writes_nothing(file, tmp_path, monkeypatch):
    """It also ends the children that compile the kernels at a low priority meanwhile."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    with running_device(jk_bms()) as path, PseudoTerminal("new", str(file), "--search", path, columns=200) as terminal:
        terminal.until(lambda: "Number of the device" in plain(terminal.output))
        terminal.until(lambda: list(tmp_path.rglob("*.nbc")))
        assert "compil" not in plain(terminal.output)
        compilers = subprocess.check_output(["ps", "--ppid", f"{terminal.process.pid}", "-o", "ni=,pid="], text=True)
        assert set(compilers.split()[::2]) == {"19"}
        terminal.process.send_signal(signal.SIGINT)
        terminal.until(lambda: "\nInterrupted; nothing was written.\r\n" in terminal.output)
        terminal.until(terminal.ended)
    assert terminal.process.returncode == 130
    assert not file.exists()
    assert not [pid for pid in compilers.split()[1::2] if Path("/proc", pid).exists()]


def test_bluetooth_is_not_searched_by_default_without_its_package(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "aiobmsble", None)
    assert _places(Prompts(yes=True))[-1] == DEFAULT_BROKER
    reason = "-  bluetooth: not searched, because a package is missing: pip install 'bms_estimator[ble]'"
    assert reason in capsys.readouterr().out
    assert "mqtt://host" in _place_kinds()
    assert "bluetooth" not in _place_kinds()


def plain(output: str) -> str:
    """Return the output without control sequences."""
    return re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", output).replace("\r", "")


def test_options_answer_all_questions_without_a_terminal(file, capsys, long_timeouts):
    with running_device(jk_bms()) as path:
        code, out, err = run(
            capsys, "new", file, "--device", path, *options(), "--no-compare", "--no-install", "--no-estimate"
        )
    assert (code, err) == (0, "")
    assert f"1  {path}: JK-BMS, 8 cells" in out
    assert f"{file}: written; house: lfp, 8 in series, 26 V, 100 Ah; jk on {path}; no broker" in out
    written = tomllib.loads(file.read_text())
    assert written["sensor"] == {"port": path, "protocol": "jk"}
    pack = {"name": "house", "cell": "lfp", "capacity_ah": 100.0, "series": 8, "parallel": 1, "max_discharge_a": 60.0}
    assert written["pack"] == pack


def test_the_service_is_installed_with_sudo(file, capsys, long_timeouts, tmp_path, monkeypatch):
    sudo = tmp_path / "sudo"
    sudo.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/arguments\nexit 3\n')
    sudo.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with running_device(jk_bms()) as path:
        code, _, _ = run(capsys, "new", file, "--device", path, *options(), "--yes", "--no-estimate", "--install")
    # 3 is the exit code of ``sudo``
    assert ((tmp_path / "arguments").read_text(), code) == (f"{PROGRAM} install {file}\n", 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--no-compare", *options(cell=None)], "--cell: missing, and there is no terminal to ask"),
        (["--yes", *options(cell=None)], "--cell: missing, and there is no default"),
        (options(), "--compare: missing"),
        (["--no-compare", *options(series="4")], "--series 4: the device reports 8 cells in series"),
        (["--no-compare", *options(broker="ftp://x")], "--broker ftp://x: must be mqtt://host:port"),
        (["--voltmeter-v", "3.3", *options()], "3.3 V: the device measures 26.40 V, which differs by more than 20%"),
        (
            ["--zero", "--ammeter-a", "5", *options()],
            "--zero: no current flows, but --ammeter-a or --direction states one",
        ),
        (["--device", "/dev/none", *options()], "--device /dev/none: was not found; found: /dev/"),
    ],
)
def test_a_missing_or_wrong_option_is_named_and_nothing_is_written(file, capsys, long_timeouts, arguments, message):
    with running_device(jk_bms()) as path:
        device = [] if "--device" in arguments else ["--device", path]
        assert message in error(run(capsys, "new", file, "--search", path, *device, *arguments))
    assert not file.exists()


def test_an_existing_file_is_not_changed(file, capsys):
    file.write_text("mine\n")
    assert f"{file}: exists already and is not changed" in error(run(capsys, "new", file, "--search", "/dev/none"))
    assert file.read_text() == "mine\n"


@pytest.mark.parametrize(
    ("option", "error"),
    [("--search", "--search: no device was found"), ("--device", "--device /dev/no: cannot be opened")],
)
def test_a_port_without_a_device_is_reported_with_the_reason_and_the_option(file, capsys, option, error):
    code, out, err = run(capsys, "new", file, option, "/dev/no", "--yes")
    assert (code, err.startswith(f"error: {error}")) == (2, True)
    assert "-  /dev/no: cannot be opened" in out


@pytest.mark.parametrize(
    ("current_a", "meter", "outputs", "expected"),
    [
        (
            -5.0,
            ["--voltmeter-v", "26.664", "--ammeter-a", "5.5"],
            ["voltage: device 26.400 V, multimeter 26.664 V: gain 1.0100", "the sign of the current is reversed"],
            {"voltage_gain": 1.01, "current_gain": 1.1, "current_sign": "discharge_positive"},
        ),
        (
            -5.0,
            ["--direction", "discharging"],
            ["current: the sign is reversed"],
            {"current_sign": "discharge_positive", "current_gain": 1.0},
        ),
        (0.3, ["--zero"], [], {"current_zero_a": -0.3}),
    ],
)
def test_a_multimeter_corrects_gain_sign_and_zero_of_a_bms(
    file, capsys, long_timeouts, current_a, meter, outputs, expected
):
    """A JK-BMS reports charge as positive, and the zero has its sign."""
    with running_device(jk_bms(current_a=current_a)) as path:
        code, out, err = run(capsys, "new", file, "--device", path, *options(), *meter, "--yes", "--no-estimate")
    assert (code, err, [text for text in outputs if text not in out]) == (0, "", [])
    sensor = load_settings(file).sensor
    assert {name: getattr(sensor, name) for name in expected} == pytest.approx(expected)


@pytest.mark.usefixtures("firmware", "patient_probe")
def test_a_multimeter_corrects_the_gains_of_the_firmware(file, capsys, tmp_path):
    readings = write_readings(tmp_path / "pack.csv", [(0.0, 5.0, 13.2, 25.0)])
    with SimavrBoard(readings) as board:
        before = read_hello(board.path)
        meter = ["--voltmeter-v", "13.464", "--ammeter-a", "5.5"]
        code, out, err = run(
            capsys, "new", file, "--device", board.path, *options(series="4"), *meter, "--yes", "--no-estimate"
        )
        after = read_hello(board.path)
    assert (code, err) == (0, ""), out
    gains = after.divider_ppm / before.divider_ppm, before.current_uv_per_a / after.current_uv_per_a
    assert gains == (pytest.approx(1.02, abs=0.01), pytest.approx(1.1, abs=0.02))
    assert tomllib.loads(file.read_text())["sensor"] == {"port": board.path, "protocol": "binary"}


def read_hello(path: str) -> Hello:
    with BoardClient(path) as client:
        return client.hello()


@pytest.fixture
def node_broker(tmp_path: Path) -> Iterator[Broker]:
    """Broker with a password, to which a simulated ESPHome node publishes."""
    broker = password_broker(tmp_path).start()
    (tmp_path / "node-password").write_text(PASSWORD)
    mqtt = MqttSettings(url=broker.url, username="owner", password_file=tmp_path / "node-password")
    node = SimulatedNode(lambda _: Reading(5.0, 52.8, 21.0), cells=16, mqtt=mqtt, speed=10.0)
    stop = Event()
    thread = Thread(target=lambda: asyncio.run(publish_until(node, stop)))
    thread.start()
    yield broker
    stop.set()
    thread.join()
    broker.stop()


async def publish_until(node: SimulatedNode, stop: Event) -> None:
    publishing = asyncio.create_task(node.run(math.inf))
    await asyncio.to_thread(stop.wait)
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)


def check_settings_with_login(file: Path, broker: Broker) -> None:
    """Check that source and service use the broker with the password, which only its owner can read."""
    settings = tomllib.loads(file.read_text())
    assert settings["source"] == {"kind": "mqtt", "profile": "esphome-jk", "prefix": "jk-bms"}
    login = {"url": broker.url, "username": "owner", "password_file": "house-mqtt.password"}
    assert settings["mqtt"] == login | {"commands": ["acknowledge_alarm"]}
    assert settings["pack"]["series"] == 16
    password = file.with_name("house-mqtt.password")
    assert password.read_text() == PASSWORD
    assert password.stat().st_mode & 0o777 == 0o600


def test_a_publisher_at_a_broker_with_a_password_is_found_with_its_values(
    node_broker, file, capsys, long_timeouts, monkeypatch
):
    monkeypatch.setattr("bms_estimator.setup.search.LISTEN_DURATION_S", 2.0)
    place = node_broker.url.replace("://", f"://owner:{quote(PASSWORD, safe='')}@")
    answers = options(series=None, parallel=None, broker=None)
    code, out, err = run(capsys, "new", file, "--search", place, *answers, "--yes", "--no-estimate")
    assert (code, err) == (0, "")
    assert re.search(rf"1  esphome-jk:jk-bms: .*{node_broker.url}; 5\d\.\d\d V, ", out)
    assert PASSWORD not in out
    assert f"{file.with_name('house-mqtt.password')}: written, mode 600" in out
    check_settings_with_login(file, node_broker)


@pytest.mark.thorough
def test_wizard_asks_for_the_password_of_a_broker_until_it_is_right(node_broker, file):
    dialog = [
        (r"Enter the user name and the password\.\n.*User name at", "owner"),
        ("Password", "wrong"),
        (r"password wrong\n *Enter the user name and the password again\.\n.*User name at", "owner"),
        ("Password", PASSWORD),
        ("Number of the device", ""),
        ("Compare the device", "n"),
        ("Cells in series", ""),
        ("MQTT broker", ""),
        ("Install the service", "n"),
    ]
    command = ("new", str(file), "--search", node_broker.url, "--no-estimate", *options(series=None, broker=None))
    with PseudoTerminal(*command, columns=200) as terminal:
        for question, answer in dialog:
            terminal.until(lambda question=question: re.search(f"{question}[^\n]*[:?] $", plain(terminal.output)))
            shown, terminal.output = terminal.output, ""
            assert PASSWORD not in shown
            terminal.press(f"{answer}\r".encode())
        terminal.until(terminal.ended)
    check_settings_with_login(file, node_broker)


@pytest.mark.usefixtures("firmware", "patient_probe")
def test_the_firmware_stores_the_zero_of_its_current(file, capsys, tmp_path):
    readings = write_readings(tmp_path / "pack.csv", [(0.0, 0.4, 13.2, 25.0)])
    with SimavrBoard(readings) as board:
        before = read_hello(board.path)
        code, out, err = run(
            capsys, "new", file, "--device", board.path, *options(series="4"), "--zero", "--yes", "--no-estimate"
        )
        after = read_hello(board.path)
    assert (code, err) == (0, "")
    assert "the board has stored the new zero" in out
    assert after.current_zero_ppm != before.current_zero_ppm
    assert "current_zero_a" not in tomllib.loads(file.read_text())["sensor"]
