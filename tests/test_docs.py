"""Links, equations and the generated site of the documentation."""

import ast
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EQUATIONS = (ROOT / "docs" / "theory" / "equations.md").read_text(encoding="utf-8")

QUICK_BUILD = {"NO_MKDOCS_2_WARNING": "1", "WITHOUT_THESIS": "1"}
"""Environment of a build without the advertisement of the theme, and without tables that take half a minute."""
MAX_WORDS = {"README.md": 650, "docs": 36_904}
"""Maximum number of words of the first page, and of all pages of the documentation but the generated ones."""
MAX_PAGES = 50
"""Maximum number of these pages."""
LAST_EQUATION = {"2": 13, "3": 19, "4": 2, "5": 2, "7": 1}
"""Number of the last equation with code, by chapter of the thesis. Later equations of chapter 4 are steps of proofs."""


def table_rows(text: str) -> list[list[str]]:
    """Return the cells of all rows of all tables."""
    return [
        [cell.strip().replace("\\|", "|") for cell in line[1:-1].split(" | ")]
        for line in text.splitlines()
        if line.startswith("| ")
    ]


@cache
def defined_names(path: Path) -> set[str]:
    """Return the names that a module defines: functions, classes, and methods as Class.method."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{child.name}" for child in node.body if isinstance(child, ast.FunctionDef)}
    return names


def code_references() -> list[tuple[str, str]]:
    """Return path and name of each code reference in docs/theory/equations.md.

    References are in the last column of the tables. A name belongs to the path before it.
    """
    references = []
    for cells in table_rows(EQUATIONS):
        path = ""
        for word in re.findall(r"`([^`]+)`", cells[-1]):
            if word.endswith(".py"):
                path = word
            else:
                references.append((path, word))
    return references


@pytest.mark.parametrize(("path", "name"), sorted(set(code_references())))
def test_the_code_of_an_equation_exists(path: str, name: str) -> None:
    assert name in defined_names(ROOT / path)


def equations_of(cell: str) -> list[tuple[str, int]]:
    """Return chapter and number of each equation of a cell like ``(2.1)`` or ``(2.5)-(2.9)``."""
    match = re.fullmatch(r"\((\d)\.(\d+)\)(?:-\(\1\.(\d+)\))?", cell)
    if match is None:
        return []
    chapter, first, last = match.groups()
    return [(chapter, number) for number in range(int(first), int(last or first) + 1)]


def test_every_equation_has_a_row_with_its_code() -> None:
    code_of_equation = {
        (chapter, number): cells[-1] for cells in table_rows(EQUATIONS) for chapter, number in equations_of(cells[0])
    }
    for chapter, last in LAST_EQUATION.items():
        for number in range(1, last + 1):
            assert re.search(r"`[\w/]+\.py`: `\w+`", code_of_equation[chapter, number])


@pytest.mark.parametrize("document", sorted(ROOT.glob("*.md")), ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_lead_to_files(document: Path) -> None:
    links = re.findall(r"\]\(([^)\s#]+)[^)]*\)", document.read_text(encoding="utf-8"))
    relative = [link for link in links if not re.match(r"[a-z]+:", link)]
    assert [link for link in relative if not (document.parent / link).exists()] == []


@pytest.mark.parametrize("name", MAX_WORDS)
def test_the_documentation_stays_short(name: str) -> None:
    """Whoever adds words removes others, as ``wc -w`` counts them."""
    pages = [ROOT / name] if name.endswith(".md") else list((ROOT / name).rglob("*.md"))
    assert len(pages) <= MAX_PAGES
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= MAX_WORDS[name]


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", tmp_path / "site"]
    process = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, env=os.environ | QUICK_BUILD
    )
    assert (process.returncode, process.stderr) == (0, "")
