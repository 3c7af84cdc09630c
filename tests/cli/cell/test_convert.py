"""``cell convert``: formats by file name suffix, and errors."""

import json

import pytest

from tests.command_line import error, run


@pytest.mark.parametrize(
    ("name", "format_name", "note"),
    [
        ("mine.json", "JSON", ""),
        ("mine.py", "parameters for PyBaMM and PyBOP", "no hysteresis"),
        ("mine.h", "C header", ""),
    ],
)
def test_the_suffix_gives_the_format(capsys, tmp_path, name, format_name, note):
    out = tmp_path / name
    code, text, err = run(capsys, "cell", "convert", "lfp", "--capacity-ah", "100", "--out", out)
    assert (code, text) == (0, f"{out}: {format_name}, 100 Ah\n")
    assert note in err
    assert bool(err) == bool(note)
    assert "mine" in out.read_text()  # the cell is named after the file


def test_a_cell_without_a_ladder_is_noted_for_a_c_header(capsys, tmp_path):
    code, _, err = run(capsys, "cell", "convert", "leaf", "--out", tmp_path / "leaf.h")
    assert code == 0
    assert "no [ladder]" in err


def test_an_existing_file_is_replaced_only_with_force(capsys, tmp_path):
    out = tmp_path / "leaf.json"
    out.write_text("{}")
    assert "--force" in error(run(capsys, "cell", "convert", "leaf", "--out", out))
    assert run(capsys, "cell", "convert", "leaf", "--out", out, "--force")[0] == 0
    assert json.loads(out.read_text())["version"] == 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("leaf.txt", "the name must end in .py (parameters for PyBaMM and PyBOP), .json (JSON), .h (C header)"),
        ("my-leaf.py", "Python cannot import a module of this name; use letters, digits and underscores"),
    ],
)
def test_an_unusable_file_name_is_an_error(capsys, tmp_path, name, message):
    code, _, err = run(capsys, "cell", "convert", "leaf", "--out", tmp_path / name)
    assert (code, err) == (2, f"error: --out {tmp_path / name}: {message}\n")
    assert not (tmp_path / name).exists()
