"""Docstrings and comments of the package avoid habits that stop a first-time reader."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

import bms_estimator

PACKAGE = Path(bms_estimator.__file__).parent
RELATIVE_CLAUSE = re.compile(r"(What|Whether|Where|Of|So|How|The same)\b")
"""Beginnings of a docstring that has neither an imperative verb nor a head noun."""
PRIVATE_WORD = re.compile(
    r"\b(told|anew|somebody|nobody|untended|doorkeeper|is none|so (long|many|much|often))\b", re.IGNORECASE
)


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line number and text of every docstring, also of docstrings after constants and attributes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Lambda | ast.IfExp):  # their body is one expression
            continue
        for child in getattr(node, "body", []):
            if (
                isinstance(child, ast.Expr)
                and isinstance(child.value, ast.Constant)
                and isinstance(child.value.value, str)
            ):
                yield child.lineno, child.value.value


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of every comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# ")


def find_habits(source: str) -> list[str]:
    """Return each docstring or comment that has one of the habits, with its line number."""
    texts = [*docstrings(ast.parse(source)), *comments(source)]
    return [f"line {line}: {text}" for line, text in texts if RELATIVE_CLAUSE.match(text) or PRIVATE_WORD.search(text)]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_docstrings_and_comments_are_plain(path: Path) -> None:
    assert find_habits(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    ['"""What was."""', 'LIMIT_S = 1.0\n"""So often it is tried [s]."""', "x = 1  # Of the pack", '"""It is told."""'],
)
def test_each_habit_is_found_in_an_example(source: str) -> None:
    assert len(find_habits(source)) == 1
