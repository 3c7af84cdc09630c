"""Command line of the board simulator: arguments, files of readings, pipes and signals."""

import math
import subprocess
from pathlib import Path

import pytest

from tests.firmware.host import Host
from tests.patience import LONG_S
from tests.simavr_board import ELF, SIMULATOR, SimavrBoard, write_readings

pytestmark = pytest.mark.usefixtures("firmware")


LSB_PER_V = 1024 / 6.1 / 5.0
"""Conversion per pack voltage [LSB/V]: 10 bits, a divider of 6.1 and a reference of 5 V."""


def run(*arguments: str | Path, text: str = "") -> subprocess.CompletedProcess[str]:
    """Run the simulator until it ends, with ``text`` on its standard input."""
    command = [SIMULATOR, *arguments]
    return subprocess.run(command, input=text, capture_output=True, text=True, timeout=LONG_S, check=False)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    process = run(ELF, "--readings", tmp_path / "none.csv")
    assert process.returncode == 2
    assert "none.csv" in process.stderr
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 0.0, 12.0)])
    process = run(tmp_path / "none.elf", "--readings", readings)
    assert process.returncode == 2
    assert "none.elf" in process.stderr


def test_file_without_readings_is_rejected(tmp_path: Path) -> None:
    process = run(ELF, "--readings", write_readings(tmp_path / "empty.csv", []))
    assert process.returncode == 2
    assert "time_s" in process.stderr


@pytest.mark.parametrize("arguments", [[], ["--speed", "0"], ["--noise-lsb", "-1"], ["--unknown"], ["--avcc-mv", "0"]])
def test_invalid_arguments_print_the_usage(tmp_path: Path, arguments: list[str]) -> None:
    readings = [] if not arguments else ["--readings", str(write_readings(tmp_path / "r.csv", [(0.0, 0.0, 12.0)]))]
    process = run(ELF, *readings, *arguments)
    assert process.returncode == 2
    assert "usage" in process.stderr


def test_signal_ends_the_simulator_without_a_host(tmp_path: Path) -> None:
    with SimavrBoard(write_readings(tmp_path / "readings.csv", [(0.0, 0.0, 12.0)])) as board:
        assert board.path  # SimavrBoard asserts a clean end


def test_file_is_repeated_with_the_option_loop(tmp_path: Path) -> None:
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 0.0, 10.0), (0.5, 0.0, 20.0), (1.0, 0.0, 10.0)])
    with SimavrBoard(readings, speed=math.inf, loop=True) as board, Host(board.path) as host:
        host.next_samples(300)
        means = [s.voltage_sum / s.count for s in host.samples]
    low, high = 10.0 * LSB_PER_V, 20.0 * LSB_PER_V  # first and second half of each second
    for second in range(3):
        assert means[100 * second + 20] == pytest.approx(low, abs=1.0)
        assert means[100 * second + 70] == pytest.approx(high, abs=1.0)


def test_readings_are_read_from_a_pipe_and_stop_at_end_ends_the_simulator() -> None:
    command = [str(SIMULATOR), str(ELF), "--readings", "-", "--speed", "inf", "--stop-at-end"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as board:
        assert board.stdin
        assert board.stdout
        board.stdin.write("0,0,10\n1,0,20\n2,0,20\n")
        board.stdin.flush()
        with Host(board.stdout.readline().strip()) as host:
            host.next_samples(150)
            board.stdin.close()
            host.until(lambda: board.poll() is not None)
            means = [s.voltage_sum / s.count for s in host.samples]
        assert board.returncode == 0
    # at 100 Hz the samples are those of 0.5 s and 1.4 s
    assert means[50] == pytest.approx(10.0 * LSB_PER_V, abs=1.0)
    assert means[140] == pytest.approx(20.0 * LSB_PER_V, abs=1.0)


def test_signal_ends_the_simulator_while_it_waits_for_readings() -> None:
    command = [str(SIMULATOR), str(ELF), "--readings", "-", "--speed", "inf"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as board:
        assert board.stdin
        assert board.stdout
        board.stdin.write("0,0,10\n1,0,20\n")
        board.stdin.flush()
        with Host(board.stdout.readline().strip()) as host:
            host.next_samples(50)  # then the simulator waits for a third line
            board.terminate()
            assert board.wait(LONG_S) == 0
