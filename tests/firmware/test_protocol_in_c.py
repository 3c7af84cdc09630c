"""Headers of the firmware, compiled for the host and compared with the shared test vectors and the Python code."""

import json
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.simulation.virtual_adc import compute_aux_count, compute_window
from tests.simavr_board import FIRMWARE

VECTORS = json.loads((FIRMWARE / "test_vectors.json").read_text())
DELIMITER_DIGITS, CRC_DIGITS = 2, 4
"""Numbers of hexadecimal digits at the end of a frame and of a packet."""

InC = Callable[[Sequence[str]], list[str]]


@pytest.fixture(scope="session")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> InC:
    """Return a function that sends lines to the program of protocol_on_host.c and returns its output lines."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc here: make apt")
    program = tmp_path_factory.mktemp("protocol") / "protocol_on_host"
    source = Path(__file__).with_name("protocol_on_host.c")
    strict = ("-std=c11", "-Wall", "-Wextra", "-Werror", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    subprocess.run([compiler, *strict, "-I", FIRMWARE / "bms_board", source, "-o", program], check=True)

    def run_lines(lines: Sequence[str]) -> list[str]:
        process = subprocess.run([program], input="\n".join(lines), capture_output=True, text=True, check=True)
        return process.stdout.splitlines()

    return run_lines


def test_messages_are_encoded_byte_for_byte(in_c: InC) -> None:
    def input_line(vector: dict[str, Any]) -> str:
        return " ".join([vector["message"], *map(str, vector["fields"].values())])

    vectors = VECTORS["messages"]
    assert in_c([input_line(v) for v in vectors]) == [f"{v['packet']} {v['frame']}" for v in vectors]


@pytest.mark.parametrize("kind", ["messages", "commands"])
def test_valid_frames_are_decoded(in_c: InC, kind: str) -> None:
    vectors = VECTORS[kind]
    lines = [f"unframe {v['frame'][:-DELIMITER_DIGITS]}" for v in vectors]
    assert in_c(lines) == [v["packet"][:-CRC_DIGITS] for v in vectors]


def test_invalid_frames_are_rejected(in_c: InC) -> None:
    vectors = VECTORS["bad_frames"]
    lines = [f"unframe {v['frame'][:-DELIMITER_DIGITS]}" for v in vectors]
    assert in_c(lines) == ["bad"] * len(vectors)


def test_timing_of_each_rate_equals_that_of_the_virtual_board(in_c: InC) -> None:
    rates = range(1, 1001)
    expected = ["{} {} {}".format(*compute_window(rate), compute_aux_count(rate)) for rate in rates]
    assert in_c([f"timing {rate}" for rate in rates]) == expected
