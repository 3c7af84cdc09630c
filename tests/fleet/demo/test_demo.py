"""``fleet demo`` as a program: it names faulty packs, and loses no block when a worker is killed."""

import subprocess

import pytest

from tests.command_line import PROGRAM
from tests.patience import LONG_S

MAX_WIDTH = 100
"""Maximum length of a line of the output [characters]."""


@pytest.mark.thorough
def test_demo_names_faulty_packs_and_loses_no_block_when_a_worker_is_killed() -> None:
    arguments = ["--packs", "20", "--seconds", "3", "--no-browser"]
    command = [PROGRAM, "fleet", "demo", *arguments]
    process = subprocess.run(command, capture_output=True, text=True, timeout=2 * LONG_S, check=False)
    assert process.returncode == 0, process.stderr
    output = " ".join(process.stdout.split())
    assert "ada and bob share the packs in 64 partitions" in output
    assert "page http://127.0.0.1:" in output
    assert "dead letter: version 4; this program reads versions 1 to 3" in output
    assert "report it 13." in output
    assert "names cell 7: its SOC is 6 % below the mean" in output
    assert "ada is killed (kill -9)" in output
    assert "bob owns all partitions" in output
    assert "undecodable blocks (dead letters) 1 lost blocks 0 takeover" in output
    assert max(map(len, process.stdout.splitlines())) <= MAX_WIDTH
