"""Page of the report that recomputes the thesis."""

from collections.abc import Iterator
from pathlib import Path

from bms_estimator.reports.report_page import render
from bms_estimator.reports.thesis.report import Report
from bms_estimator.reports.thesis.report_items import Figure, Item, Reproduction, Table, label, name

CSS_CLASSES = {
    Reproduction.FITTED: "fitted",
    Reproduction.RECOMPUTED: "recomputed",
    Reproduction.CLAIM_HOLDS: "holds",
    Reproduction.CLAIM_FAILS: "fails",
    Reproduction.NO_DATA: "no-data",
    Reproduction.CONTRADICTED: "contradicted",
    Reproduction.GIVEN: "given",
    Reproduction.ADDED: "added",
}
"""CSS class of each verdict."""
LONG_CELL = 40
"""Maximum length of a cell in a table of numbers [characters]. A table with a longer cell is left-aligned and wraps its
lines."""


def page(report: Report) -> str:
    """Return the whole page."""
    return render(
        "thesis.html",
        report=report,
        css=CSS_CLASSES,
        counts=list(_counts(report)),
        label=label,
        name=name,
        anchor=_anchor,
        short=_short,
        is_brief=_is_brief,
        has_long_cell=has_long_cell,
        column_styles=_column_styles,
    )


def write(report: Report, folder: Path) -> Path:
    """Write ``index.html`` into ``folder``. Return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "index.html"
    path.write_text(page(report), encoding="utf-8")
    return path


def has_long_cell(table: Table) -> bool:
    """Return True if the table is left-aligned, because it has a cell longer than ``LONG_CELL``."""
    return any(len(cell) > LONG_CELL for row in table.rows for cell in row)


def _anchor(item: Item) -> str:
    """Return the HTML id of an item."""
    return f"{item.kind}-{item.key}".lower().replace(" ", "-")


def _short(item: Item) -> str:
    """Return the short name of an item, such as T 5 or F 19."""
    if item.verdict is Reproduction.ADDED:
        return item.key
    return f"{'T' if isinstance(item, Table) else 'F'} {item.key}"


def _counts(report: Report) -> Iterator[tuple[Reproduction, int, str]]:
    """Yield each verdict that occurs, the number of its items, and its text."""
    for verdict in CSS_CLASSES:
        count = sum(item.verdict is verdict for item in report.items)
        if count:
            yield verdict, count, "diagram, photograph or input" if verdict is Reproduction.GIVEN else verdict.value


def _is_brief(item: Item) -> bool:
    """Return True for a diagram or photograph, which has only a title."""
    return isinstance(item, Figure) and not item.svg and item.verdict is Reproduction.GIVEN


def _column_styles(table: Table) -> list[str]:
    """Return the CSS class of each column: printed values are faint, and values of this project bold."""

    def style(column: str) -> str:
        # "joint" is the joint fit of Table 8
        if column.startswith("printed"):
            return "print"
        return "own" if column.startswith(("recomputed", "joint")) else ""

    return [style(column) for column in table.columns]
