"""The folder of compiled kernels is named by all that goes into them."""

import ast
from pathlib import Path

import bms_estimator
from bms_estimator import kernels

PACKAGE = Path(bms_estimator.__file__).parent


def imported(source: Path) -> set[Path]:
    """Files of the package that one of its files imports."""
    names = [node.module for node in ast.walk(ast.parse(source.read_text())) if isinstance(node, ast.ImportFrom)]
    paths = [PACKAGE.parent / f"{name.replace('.', '/')}.py" for name in names if name]
    return {path for path in paths if path.is_relative_to(PACKAGE) and path.is_file()}


def test_every_file_that_a_kernel_imports_is_in_the_caches_name() -> None:
    found = set().union(*(imported(source) for source in kernels.COMPILED_IN))
    assert PACKAGE / "model" / "suspect.py" in found
    assert found <= set(kernels.COMPILED_IN)
