"""Notebook of the documentation: it runs, and its committed outputs are those of this version."""

import pytest
from nbformat import NotebookNode

from tests.library import notebook


def texts(cells: list[NotebookNode]) -> list[str]:
    """Return the printed output of each cell."""
    outputs = ([each for each in cell.get("outputs", []) if each.output_type == "stream"] for cell in cells)
    return ["".join(each.text for each in streams if each.name == "stdout") for streams in outputs]


def picture_counts(cells: list[NotebookNode]) -> list[int]:
    """Return the number of pictures below each cell."""
    outputs = (cell.get("outputs", []) for cell in cells)
    return [sum("image/png" in each.get("data", {}) for each in of_cell) for of_cell in outputs]


def test_a_new_run_of_the_notebook_has_the_committed_outputs():
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: the notebook draws plots")
    committed, run = notebook.read().cells, notebook.execute().cells
    assert texts(run) == texts(committed), "run: make notebook"
    assert picture_counts(run) == picture_counts(committed)
    assert sum(picture_counts(run)) == 6
