"""Report as one self-contained HTML page, without scripts and external resources."""

from html import escape
from pathlib import Path

from bms_estimator.reports.report_items import Figure, Item, Reproduction, Table, label, name
from bms_estimator.reports.thesis_report import Report
from bms_estimator.version import __version__

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

STYLE = """
:root { --ink: #1d2733; --soft: #5a6776; --line: #dfe4ea; --paper: #fff; --shade: #f5f7f9; --accent: #1f5fa8; }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; scroll-padding-top: 1rem; }
body { margin: 0; color: var(--ink); background: var(--paper); font: 16px/1.55 system-ui, "Segoe UI", Roboto,
  "Helvetica Neue", Arial, sans-serif; display: grid; grid-template-columns: 15.5rem minmax(0, 1fr); }
nav { position: sticky; top: 0; align-self: start; height: 100vh; overflow-y: auto; padding: 1.6rem 1rem 2rem 1.4rem;
  border-right: 1px solid var(--line); background: var(--shade); font-size: .82rem; line-height: 1.4; }
nav b { display: block; margin: .9rem 0 .25rem; }
nav .marks { display: flex; flex-wrap: wrap; gap: .25rem; }
nav .marks a { padding: 0 .4rem; border-radius: .3rem; border-left-width: 3px; border-left-style: solid; color: var(--ink);
  text-decoration: none; font-variant-numeric: tabular-nums; }
main { max-width: 62rem; padding: 2.2rem 2.4rem 5rem; width: 100%; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 .4rem; letter-spacing: -.01em; }
h2 { margin: 3.2rem 0 1rem; padding-bottom: .35rem; border-bottom: 2px solid var(--ink); font-size: 1.3rem; }
article { margin: 0 0 2.4rem; padding-top: .2rem; }
article.brief { margin: 0 0 .9rem; } article.brief h3 { margin: 0; font-weight: 500; } article.brief p { display: none; }
h3 { font-size: 1.02rem; margin: 0 0 .5rem; display: flex; flex-wrap: wrap; gap: .55rem; align-items: baseline; }
h3 .no { color: var(--accent); white-space: nowrap; }
p { margin: .5rem 0; } .reason { color: var(--soft); font-size: .9rem; max-width: 54rem; }
.badge { font-size: .72rem; font-weight: 600; padding: .08rem .5rem; border-radius: 1rem; white-space: nowrap; }
.fitted { background: #e0ecfa; color: #174c88; border-color: #1f5fa8; }
.recomputed { background: #e3f1f3; color: #1d5661; border-color: #4aa3b5; }
.holds { background: #dff2e6; color: #17613a; border-color: #2f8f5b; }
.fails { background: #f9dfdf; color: #8a1c1c; border-color: #c23b3b; }
.no-data { background: #fbeadf; color: #8c3b12; border-color: #d1602b; }
.contradicted { background: #f9dfdf; color: #8a1c1c; border-color: #c23b3b; }
.given { background: #eceff2; color: #515c68; border-color: #8a97a6; }
.added { background: #f0e6f5; color: #643579; border-color: #8a4fa3; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid var(--line); vertical-align: bottom; }
th { font-weight: 600; max-width: 9.5rem; line-height: 1.3; border-bottom: 1.5px solid var(--ink); }
td { white-space: nowrap; } .text td { white-space: normal; }
th:first-child, td:first-child { text-align: left; padding-left: 0; white-space: nowrap; }
tbody tr:hover { background: var(--shade); }
td.own { font-weight: 600; } td.print { color: var(--soft); }
.text td { text-align: left; vertical-align: top; } .text th { text-align: left; }
.text td:nth-child(2) { min-width: 15rem; }
.counts { display: flex; flex-wrap: wrap; gap: .6rem; margin: 1.2rem 0 .6rem; padding: 0; list-style: none; }
.counts li { padding: .5rem .9rem; border-radius: .5rem; font-size: .85rem; }
.counts strong { font-size: 1.3rem; display: block; line-height: 1.2; }
svg { max-width: 100%; height: auto; display: block; }
footer { color: var(--soft); font-size: .85rem; margin-top: 3rem; }
@media (max-width: 60rem) { body { display: block; } nav { display: none; } main { padding: 1.2rem; } }
@media print { nav { display: none; } body { display: block; } article { break-inside: avoid; } }
"""
"""Style sheet of the page."""

LONG_CELL = 40
"""Maximum length of a cell in a table of numbers [characters]. A table with a longer cell is left-aligned and wraps its
lines."""

INTRODUCTION = """
<p>Every table and figure of “Adaptive estimation of Li-ion battery model parameters”, recomputed and compared with the printed values.
The reason for each difference is given; <a href="#table-errata">E1 to E36</a> are the errata of the thesis, whose corrections this
project uses. Only the text of the thesis with its numbers and tables was available; the content of its figures was not.
Errors are always in percent of the true value.</p>
<p>Values that the thesis does not print are chosen as follows:</p>
<ul>
<li>Nussbaum gain: N(k) = E<sub>2.5</sub>(-k<sup>2.5</sup>), k<sub>0</sub> = 0.</li>
<li>Initial state: x<sub>2</sub>(0) = x<sub>3</sub>(0) = 0. Schemes 1 and 2 use the initial state and λ of erratum E25.</li>
<li>Simulations: 100 Hz, and 10 Hz for runs at C/10. The semi-exact step is stable at any step length.</li>
</ul>
"""


def page(report: Report) -> str:
    """Return the whole page."""
    chapters = "".join(
        f"<h2>{escape(chapter)}</h2>{''.join(_article(item) for item in items)}" for chapter, items in report.chapters
    )
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>The thesis, recomputed</title><style>{STYLE}</style></head><body>{_navigation(report)}<main>"
        f"<h1>The thesis, recomputed</h1>{INTRODUCTION}<p>Chapter 5 was run on <strong>{escape(report.data_source)}</strong>.</p>"
        f"{_counts(report)}{chapters}{_summary(report)}"
        f"<footer>bms_estimator {escape(__version__)}</footer></main></body></html>"
    )


def write(report: Report, folder: Path) -> Path:
    """Write ``index.html`` into ``folder``. Return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "index.html"
    path.write_text(page(report), encoding="utf-8")
    return path


def _anchor(item: Item) -> str:
    """Return the HTML id of an item."""
    return f"{item.kind}-{item.key}".lower().replace(" ", "-")


def _navigation(report: Report) -> str:
    """Return the side bar with links to all items."""
    parts = ["<nav>"]
    for chapter, items in report.chapters:
        links = "".join(
            f'<a class="{CSS_CLASSES[item.verdict]}" href="#{_anchor(item)}" title="{escape(item.title)}">{_short(item)}</a>'
            for item in items
        )
        parts.append(f'<b>{escape(chapter)}</b><div class="marks">{links}</div>')
    return "".join([*parts, '<b><a href="#summary">Summary</a></b></nav>'])


def _short(item: Item) -> str:
    """Return the short name of an item, such as T 5 or F 19."""
    if item.verdict is Reproduction.ADDED:
        return item.key
    return f"{'T' if isinstance(item, Table) else 'F'} {item.key}"


def _counts(report: Report) -> str:
    """Return the list of verdicts, each with its number of items."""
    parts = []
    for verdict, css in CSS_CLASSES.items():
        count = sum(item.verdict is verdict for item in report.items)
        if count:
            words = "diagram, photograph or input" if verdict is Reproduction.GIVEN else verdict.value
            parts.append(f'<li class="{css}"><strong>{count}</strong>{escape(words)}</li>')
    return f'<ul class="counts">{"".join(parts)}</ul>'


def _badge(item: Item) -> str:
    return f'<span class="badge {CSS_CLASSES[item.verdict]}">{escape(label(item))}</span>'


def _article(item: Item) -> str:
    head = f'<h3><span class="no">{escape(name(item))}</span> {escape(item.title)} {_badge(item)}</h3>'
    body = item.svg if isinstance(item, Figure) else _table(item)
    brief = ' class="brief"' if isinstance(item, Figure) and not item.svg and item.verdict is Reproduction.GIVEN else ""
    return f'<article id="{_anchor(item)}"{brief}>{head}{body}<p class="reason">{escape(item.reason)}</p></article>'


def _table(table: Table) -> str:
    """Return a table in which printed values are faint and values of this project bold."""

    def style(column: str) -> str:
        # "joint" is the joint fit of Table 8
        if column.startswith("printed"):
            return ' class="print"'
        return ' class="own"' if column.startswith(("recomputed", "joint")) else ""

    header_cells = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    rows = "".join(
        "<tr>"
        + "".join(f"<td{style(column)}>{escape(cell)}</td>" for column, cell in zip(table.columns, row, strict=True))
        + "</tr>"
        for row in table.rows
    )
    css_class = ' class="text"' if any(len(cell) > LONG_CELL for row in table.rows for cell in row) else ""
    return f'<div class="scroll"><table{css_class}><thead><tr>{header_cells}</tr></thead><tbody>{rows}</tbody></table></div>'


def _summary(report: Report) -> str:
    """Return the table of all items with their verdicts and reasons."""
    rows = "".join(
        f'<tr><td><a href="#{_anchor(item)}">{_short(item)}</a></td><td>{escape(item.title)}</td>'
        f"<td>{_badge(item)}</td><td>{escape(item.reason)}</td></tr>"
        for item in report.items
    )
    return (
        '<h2 id="summary">Summary of the verdicts</h2><div class="scroll"><table class="text"><thead><tr><th></th>'
        f"<th>title</th><th>verdict</th><th>reason</th></tr></thead><tbody>{rows}</tbody></table></div>"
    )
