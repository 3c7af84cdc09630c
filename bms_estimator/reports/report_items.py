"""Items of a report: tables and figures of the thesis, each with its reproduction."""

from dataclasses import dataclass, field
from enum import Enum


class Reproduction(Enum):
    """Reproduction of a table or figure."""

    FITTED = "fitted"
    """Agrees with print after corrections and after fitting free parameters that the thesis does not print."""
    RECOMPUTED = "recomputed"
    """Computed from printed values, compared with nothing: the thesis prints no value of it."""
    NO_DATA = "no data printed"
    """The recording, load or model behind it is not published."""
    CONTRADICTED = "contradicted by the thesis's own numbers"
    """Other printed numbers of the thesis give another result."""
    CLAIM_HOLDS = "claim tested on other data: holds"
    """Verdict on a claim of the thesis about its recordings, tested on others."""
    CLAIM_FAILS = "claim tested on other data: fails"
    GIVEN = "given"
    """Input data, a diagram or a photograph: there is nothing to compute."""
    ADDED = "added"
    """Label of an item that is not in the thesis."""


@dataclass(frozen=True)
class Table:
    """A table: printed beside recomputed.

    Attributes:
        key: "5" for Table 5 of the thesis; the name of one that is not in it.
        title: Caption.
        columns: Headings.
        rows: One list of cells for each row.
        verdict: What became of it.
        reason: Why it differs from print, or what the agreement rests on.
        free: Free parameters of a fit; 0 without one.
    """

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    verdict: Reproduction
    reason: str
    free: int = 0

    kind: str = field(default="Table", init=False)


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        key: "19" for Figure 19 of the thesis.
        title: Caption.
        svg: The plot, one ``<svg>`` element; empty for a diagram or photograph.
        verdict: What became of it.
        reason: Content, and difference from print with its reason.
    """

    key: str
    title: str
    svg: str
    verdict: Reproduction
    reason: str

    kind: str = field(default="Figure", init=False)


Item = Table | Figure


def name(item: Item) -> str:
    """Table 5, Figure 19; an item that is not in the thesis by its key alone."""
    return item.key if item.verdict is Reproduction.ADDED else f"{item.kind} {item.key}"


def label(item: Item) -> str:
    """Verdict in words; of a fit with the number of its free parameters."""
    if item.verdict is Reproduction.FITTED and isinstance(item, Table):
        return f"{item.verdict.value}, {item.free} free parameters"
    return item.verdict.value


def number(value: float, digits: int = 4) -> str:
    """Format a number for tables: significant digits, no needless exponent."""
    if value != value:  # NaN  # noqa: PLR0124
        return "-"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-4 <= abs(value) < 1e9:
        text = f"{value:.{max(digits - 1, 0)}f}" if abs(value) < 1 else f"{value:.0f}"
    return text


def percent(value: float, true: float) -> str:
    """Error of ``value`` in percent of the true value (E7)."""
    error = 100.0 * abs(value - true) / abs(true)
    return "0" if error < 1e-4 else number(error, 3)
