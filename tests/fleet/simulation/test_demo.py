"""``fleet demo`` as a program: it reports two workers, a kill and a takeover."""

import subprocess

from tests.command_line import PROGRAM
from tests.patience import LONG_S


def test_demo_ends_and_reports_workers_a_kill_and_no_lost_block() -> None:
    arguments = ["--packs", "20", "--seconds", "3", "--no-browser"]
    command = [PROGRAM, "fleet", "demo", *arguments]
    process = subprocess.run(command, capture_output=True, text=True, timeout=2 * LONG_S, check=False)
    assert process.returncode == 0, process.stderr
    assert "two workers: ada and bob, which share 64 partitions of the packs" in process.stdout
    assert "the fleet's page: http://127.0.0.1:" in process.stdout
    assert "ada is killed" in process.stdout
    assert "blocks are in the stream" in process.stdout
    assert ", 0 lost;" in process.stdout
