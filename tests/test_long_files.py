"""List of the files that the test run begins with."""

from pathlib import Path

from tests.conftest import LONG_FILES

PROJECT = Path(__file__).parents[1]


def test_each_file_exists() -> None:
    assert [file for file in LONG_FILES if not (PROJECT / file).exists()] == []
