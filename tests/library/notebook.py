"""Notebook of the documentation; ``python -m tests.library.notebook`` executes it and writes its outputs."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

from tests.patience import LONG_S

FILE = Path(__file__).parents[2] / "docs" / "library" / "identify.ipynb"


def read() -> NotebookNode:
    """Return the notebook as committed."""
    return nbformat.read(FILE, as_version=4)


def execute() -> NotebookNode:
    """Execute the notebook, and return it with its new outputs."""
    notebook = read()
    NotebookClient(notebook, timeout=int(LONG_S), kernel_name="python3").execute(cwd=FILE.parent)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times, which change with each run
    return notebook


if __name__ == "__main__":
    nbformat.write(execute(), FILE)
