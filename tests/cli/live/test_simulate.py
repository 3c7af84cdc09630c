"""Process of command ``simulate``: bytes of a board on the printed path, until an interrupt."""

import contextlib
import os
import re
import select
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.kernels.cell_model.fuel_cell import polarisation
from bms_estimator.kernels.observer.records import LEARNABLE
from bms_estimator.model.pack_model import load_fuel_cell
from bms_estimator.protocols.base.relay import Relay
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import set_rate_command, set_relay_command
from tests.command_line import PROGRAM, error, run
from tests.patience import LONG_S

RATE_HZ = 50
"""Sample rate at the start; different from the rate that the test requests [Hz]."""


@contextlib.contextmanager
def simulate(*arguments):
    """Run ``simulate`` as a process. Yield the process and the path that it prints."""
    command = [PROGRAM, "simulate", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


@contextlib.contextmanager
def open_line(path):
    """Open the line at a path. Yield its file descriptor."""
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def read(descriptor, is_enough, data=b""):
    """Read bytes and append them to ``data`` until ``is_enough(data)`` is True. Return all of them."""
    end_s = time.monotonic() + LONG_S
    while not is_enough(data):
        assert time.monotonic() < end_s, f"{len(data)} bytes arrived, which are not enough"
        if select.select([descriptor], [], [], 0.5)[0]:
            data += os.read(descriptor, 4096)
    return data


def decode(data):
    """Return the samples in the bytes, and the decoder with its counters."""
    decoder = FrameDecoder()
    return decoder.feed(0.0, data), decoder


def last_period_s(data):
    """Return the time between the last two samples [s]."""
    return np.diff(decode(data)[0]["time_s"])[-1]


def test_frames_of_the_configured_pack_are_sent_until_ctrl_c():
    arguments = ("--series", "6", "--load", "constant", "--current-a", "0.5", "--rate-hz", str(RATE_HZ))
    with simulate(*arguments) as (process, path):
        assert Path(path).is_char_device()
        with open_line(path) as line:
            data = read(line, lambda data: decode(data)[0].size >= RATE_HZ)
            os.write(line, set_rate_command(100))
            later = read(line, lambda data: last_period_s(data) < 0.015, data)
        block, decoder = decode(data)
        assert decoder.board["sample_rate_hz"] == str(RATE_HZ)
        assert decoder.counters.crc_errors == 0
        assert decoder.counters.frames_lost == 0
        assert np.allclose(np.diff(block["time_s"]), 1.0 / RATE_HZ, rtol=0.0, atol=1e-5)
        assert block["current_a"].mean() == pytest.approx(0.5, abs=0.05)
        assert block["voltage_v"].mean() == pytest.approx(6 * 3.9, abs=1.0)
        assert last_period_s(later) == pytest.approx(1.0 / 100, rel=0.01)  # the rate requested by the host
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, out) == (0, "")
    assert re.fullmatch(r"[\d,]+ samples in \d+\.\d s, SOC \d+\.\d\d%\n", err)


def test_a_board_measures_a_fuel_cell_under_a_constant_load():
    stack, current_a = load_fuel_cell("pem_30w"), 3.0
    expected_v = polarisation(stack.a, np.zeros(LEARNABLE), np.full(1, current_a), np.full(1, np.nan))[0][0]
    arguments = ("--cell", "pem_30w", "--load", "constant", "--current-a", str(current_a))
    with simulate(*arguments) as (process, path):
        with open_line(path) as line:
            samples = decode(read(line, lambda data: decode(data)[0].size >= RATE_HZ))[0]
        process.send_signal(signal.SIGINT)
        err = process.communicate(timeout=LONG_S)[1]
    assert samples["current_a"].mean() == pytest.approx(current_a, abs=0.05)
    assert samples["voltage_v"].mean() == pytest.approx(expected_v, abs=0.1)
    assert re.fullmatch(r"[\d,]+ samples in \d+\.\d s\n", err)


@pytest.mark.parametrize("option", [("--capacity-ah", "3"), ("--protocol", "jk"), ("--load", "relay")])
def test_options_of_batteries_are_rejected_for_a_fuel_cell(option, capsys):
    err = error(run(capsys, "simulate", "--cell", "pem_30w", *option))
    assert "--cell pem_30w: a fuel cell is simulated on a board without relay; omit --capacity-ah" in err


@pytest.mark.thorough
def test_the_relay_of_the_board_connects_the_load():
    with simulate("--load", "relay", "--current-a", "0.5", "--noise-lsb", "0") as (_, path), open_line(path) as line:
        data = read(line, lambda data: decode(data)[0].size >= 10)
        assert abs(decode(data)[0]["current_a"]).max() < 0.1
        os.write(line, set_relay_command(Relay(high=True, high_when_silent=None)))
        read(line, lambda data: decode(data)[0]["current_a"][-1] == pytest.approx(0.5, abs=0.05), data)


@pytest.mark.thorough
def test_text_lines_have_the_format_of_a_sketch():
    with simulate("--text", "--current-a", "0.2", "--load", "constant") as (process, path):
        with open_line(path) as line:
            lines = read(line, lambda data: data.count(b"\r\n") >= 20).split(b"\r\n")[:-1]
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_S) == 0
    assert [line for line in lines if not re.fullmatch(rb"\d\.\d{3},-?\d\.\d{3}(,-?\d+\.\d)?", line)] == []
    assert np.mean([float(line.split(b",")[1]) for line in lines]) == pytest.approx(0.2, abs=0.05)


def test_simulation_ends_after_the_simulated_duration(capsys):
    code, _, err = run(capsys, "simulate", "--seconds", 4, "--speed", 20, "--load", "constant", "--current-a", 0)
    assert code == 0
    assert re.fullmatch(r"40[01] samples in 4\.0 s, SOC 90\.00%\n", err)


@pytest.mark.thorough
def test_default_load_of_a_battery_monitor_is_1c():
    arguments = ("--cell", "lfp", "--capacity-ah", "100", "--load", "constant")
    with simulate("--protocol", "vedirect", *arguments) as (_, path), open_line(path) as line:
        data = read(line, lambda data: re.search(rb"\r\nI\t-?\d+\r\n", data) is not None)
    assert float(re.search(rb"\r\nI\t(-?\d+)\r\n", data)[1]) == pytest.approx(
        -100e3, rel=0.01
    )  # mA, negative on discharge


@pytest.mark.parametrize(
    "arguments",
    [
        ("--cell", "nonsense"),
        ("--load", "nonsense"),
        ("--rate-hz", "2000"),
        ("--current-a", "nan"),
        ("--current-a", "inf"),
        ("--soc", "nan"),
        ("--speed", "inf"),
        ("--protocol", "nonsense"),
        ("--protocol", "jbd", "--series", "40"),
        ("--load", "relay", "--text"),
    ],
)
def test_invalid_arguments_are_reported(arguments, capsys):
    code, out, err = run(capsys, "simulate", *arguments)
    assert (code, out) == (2, "")
    assert arguments[-1] in err or arguments[0] in err
