"""Report of the whole thesis, as a page: tables and figures in the thesis's order."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from bms_estimator.model.errors import UserError
from bms_estimator.reports.report_parts import render
from bms_estimator.reports.thesis import (
    errata,
    experiment_figures,
    experiment_tables,
    printed_pack,
    simulation_figures,
    simulation_tables,
)
from bms_estimator.reports.thesis.experiment import Experiment, RecordedCaptures
from bms_estimator.reports.thesis.report_items import Figure, Item, Reproduction, Table, label, name
from bms_estimator.reports.thesis.simulation import Simulation

DIAGRAMS = {
    "1": "Chen and Mora's battery model",
    "2": "Simulation block diagram for Chen and Mora's model",
    "11": "Overall architecture",
    "12": "Simulink model for simulation",
    "18": "The three steps of the estimation",
    "24": "Block diagram of the experimental setup",
    "25": "Photograph of the test bench",
    "44": "Photograph of a fuel cell",
    "45": "Voltage of a fuel cell",
    "46": "Voltage of a fuel cell, estimated",
    "47": "Simulink diagram of the algorithm",
    "48": "Simulink diagram of the adaptive model",
    "49": "Simulink diagram of C_ts",
    "50": "Simulink diagram of the Mittag-Leffler function",
}
"""Figures without anything to compute, by number."""
FUEL_CELL_REASONS = dict.fromkeys(
    ("45", "46"),
    "The recording is not published, nor are the equations of its model. The project's own model of a fuel cell, after section "
    "7.3, is in docs/theory/fuel-cell.md.",
)
"""Reason why the figures of a fuel cell are not reproduced, by number."""

CHAPTERS: dict[str, tuple[str, ...]] = {
    "2  The model and the Nussbaum gain": ("F1", "F2", "F3", "F4", "F5", "F6", "F7", "F8", "F9", "F10"),
    "3  Three schemes": ("F11", "T1", "F12", "F13", "F14", "T2", "F15", "T3", "F16", "F17", "T4"),
    "4  The improved method": ("F18", "F19", "F20", "T5", "F21", "F22", "T6", "F23", "T7", "TTheorem 4.1.2"),
    "5  Experiments": (
        "F24",
        "F25",
        "F26",
        "T8",
        "F27",
        "F28",
        "F29",
        "F30",
        "T9",
        "F31",
        "T10",
        "F32",
        "F33",
        "F34",
        "F35",
        "F36",
        "F37",
        "F38",
    ),
    "6  Comparison": ("F39", "T11", "T12", "F40", "T13"),
    "7  SOC, faults, fuel cell": ("F41", "F42", "F43", "F44", "F45", "F46"),
    "A  Simulink models": ("F47", "F48", "F49", "F50"),
    "Errata": ("TErrata",),
}
"""Marks of tables (T) and figures (F) by chapter, in the order of the thesis."""


@dataclass(frozen=True)
class Report:
    """Result of a report.

    Attributes:
        data_source: Description of the data of chapter 5.
        chapters: Chapters with their items.
    """

    data_source: str
    chapters: tuple[tuple[str, tuple[Item, ...]], ...]

    @property
    def items(self) -> list[Item]:
        """Items of all chapters."""
        return [item for _, items in self.chapters for item in items]


def _builders(simulation: Simulation, experiment: Experiment) -> dict[str, Callable[[], Item]]:
    """Return the functions that build the items, by mark such as T5 or F19."""
    builders: dict[str, Callable[[], Item]] = {}
    builders |= {f"T{key}": partial(make, simulation) for key, make in simulation_tables.TABLES.items()}
    builders |= {f"F{key}": partial(make, simulation) for key, make in simulation_figures.FIGURES.items()}
    builders |= {f"T{key}": partial(make, experiment) for key, make in experiment_tables.TABLES.items()}
    builders |= {f"F{key}": partial(make, experiment) for key, make in experiment_figures.FIGURES.items()}
    if experiment.recorded is None:  # without captures these are computed from the printed values
        builders |= {f"F{key}": make for key, make in printed_pack.FIGURES.items()}
    return (
        builders
        | {"TErrata": partial(errata.table, simulation)}
        | {f"F{key}": partial(_diagram, key) for key in DIAGRAMS}
    )


def _diagram(key: str) -> Figure:
    """Return a figure without anything to compute."""
    verdict = Reproduction.NO_DATA if key in FUEL_CELL_REASONS else Reproduction.GIVEN
    reason = FUEL_CELL_REASONS.get(key, "A diagram or photograph: there is nothing to compute.")
    return Figure(key, DIAGRAMS[key], "", verdict, reason)


def build(
    recorded: RecordedCaptures | None = None,
    *,
    table: str | None = None,
    figure: str | None = None,
    progress: Callable[[str, int, int], None] = lambda _title, _done, _total: None,
) -> Report:
    """Recompute the thesis, or one table or figure of it.

    Args:
        recorded: Real captures for chapter 5; None: the simulated pack.
        table: Number of the only table to compute.
        figure: Number of the only figure to compute.
        progress: Called with the name of the next item, the number of finished items, and the total.

    Raises:
        UserError: There is no such table or figure, or chapter 5 cannot be run on the captures.
    """
    experiment = Experiment(recorded)
    if recorded is not None:
        # raises for unusable captures, before half a minute of simulations
        _ = experiment.procedure.r_s_fit
    builders = _builders(Simulation(), experiment)
    selected = _select(builders, table, figure)
    total, done = sum(len(marks) for _, marks in selected), 0
    chapters = []
    for chapter, marks in selected:
        items = []
        for mark in marks:
            progress(f"{'Table' if mark[0] == 'T' else 'Figure'} {mark[1:]}", done, total)
            items.append(builders[mark]())
            done += 1
        chapters.append((chapter, tuple(items)))
    progress("done", done, total)
    return Report(experiment.data_source, tuple(chapters))


def _select(
    builders: dict[str, Callable[[], Item]], table: str | None, figure: str | None
) -> Sequence[tuple[str, tuple[str, ...]]]:
    """Return chapters and marks of the requested items."""
    requested = [f"T{table}"] * (table is not None) + [f"F{figure}"] * (figure is not None)
    for mark in requested:
        if mark not in builders:
            raise UserError(
                f"the thesis has no {'table' if mark[0] == 'T' else 'figure'} {mark[1:]}: tables are 1 to 13, figures 1 to 50"
            )
    if not requested:
        return list(CHAPTERS.items())
    return [
        (chapter, tuple(mark for mark in marks if mark in requested))
        for chapter, marks in CHAPTERS.items()
        if set(marks) & set(requested)
    ]


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
        short=_short,
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


def _column_styles(table: Table) -> list[str]:
    """Return the CSS class of each column: printed values are faint, and values of this project bold."""

    def style(column: str) -> str:
        # "joint" is the joint fit of Table 8
        if column.startswith("printed"):
            return "print"
        return "own" if column.startswith(("recomputed", "joint")) else ""

    return [style(column) for column in table.columns]
