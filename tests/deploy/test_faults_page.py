"""What docs/faults.md says is tested, is."""

import re
from pathlib import Path

TESTS = Path(__file__).parents[1]
PAGE = TESTS.parent / "docs/faults.md"


def test_every_test_that_the_fault_matrix_names_exists():
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    matrix = [row for row in rows if row.count(" | ") == 3]
    named = {name for row in matrix for name in re.findall(r"`(\w+)`", row.rsplit(" | ", 1)[-1])}
    there = {name for path in TESTS.rglob("test_*.py") for name in re.findall(r"def test_(\w+)", path.read_text())}
    assert len(named) > 50
    assert named - there == set()
