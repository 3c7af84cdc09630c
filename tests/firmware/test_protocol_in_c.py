"""The board's own headers, compiled on the host, against the shared vectors and the host's arithmetic."""

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

InC = Callable[[Sequence[str]], list[str]]


@pytest.fixture(scope="session")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> InC:
    """Answers lines as protocol_on_host.c says."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc here: make apt")
    program = tmp_path_factory.mktemp("protocol") / "protocol_on_host"
    source = Path(__file__).with_name("protocol_on_host.c")
    strict = ("-std=c11", "-Wall", "-Wextra", "-Werror", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    subprocess.run([compiler, *strict, "-I", FIRMWARE / "bms_board", source, "-o", program], check=True)

    def answer(questions: Sequence[str]) -> list[str]:
        ran = subprocess.run([program], input="\n".join(questions), capture_output=True, text=True, check=True)
        return ran.stdout.splitlines()

    return answer


def test_messages_are_encoded_byte_for_byte(in_c: InC) -> None:
    def question(vector: dict[str, Any]) -> str:
        return " ".join([vector["message"], *map(str, vector["fields"].values())])

    vectors = VECTORS["messages"]
    assert in_c([question(v) for v in vectors]) == [f"{v['packet']} {v['frame']}" for v in vectors]


@pytest.mark.parametrize("kind", ["messages", "commands"])
def test_good_frames_are_unpacked(in_c: InC, kind: str) -> None:
    vectors = VECTORS[kind]
    assert in_c([f"unframe {v['frame'][:-2]}" for v in vectors]) == [v["packet"][:-4] for v in vectors]


def test_bad_frames_are_refused(in_c: InC) -> None:
    vectors = VECTORS["bad_frames"]
    assert in_c([f"unframe {v['frame'][:-2]}" for v in vectors]) == ["bad"] * len(vectors)


def test_every_rate_divides_the_clock_as_the_virtual_board_does(in_c: InC) -> None:
    rates = range(1, 1001)
    divided = ["{} {} {}".format(*compute_window(rate), compute_aux_count(rate)) for rate in rates]
    assert in_c([f"timing {rate}" for rate in rates]) == divided
