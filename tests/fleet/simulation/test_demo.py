"""``fleet demo`` as a program: it reports two workers, a kill and a takeover, and leaves nothing behind."""

import subprocess

from tests.command_line import PROGRAM
from tests.patience import LONG_S


def test_demo_ends_and_reports_its_progress() -> None:
    arguments = ["--packs", "20", "--seconds", "3", "--no-browser"]
    command = [PROGRAM, "fleet", "demo", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=2 * LONG_S, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "two workers: ada and bob, which share 64 partitions of the packs" in ended.stdout
    assert "the fleet's page: http://127.0.0.1:" in ended.stdout
    assert "ada is killed" in ended.stdout
    assert "blocks are in the stream" in ended.stdout
    assert ", 0 lost;" in ended.stdout
