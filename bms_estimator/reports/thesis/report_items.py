"""Items of a report: tables and figures of the thesis, each with its reproduction."""

from dataclasses import dataclass, field
from enum import Enum


class Reproduction(Enum):
    """Verdict on the reproduction of a table or figure."""

    FITTED = "fitted"
    """Agrees with the printed values after corrections and a fit of parameters that the thesis does not print."""
    RECOMPUTED = "recomputed"
    """Computed from printed values. The thesis prints no value to compare with."""
    NO_DATA = "no data printed"
    """The recording, load or model behind it is not published."""
    CONTRADICTED = "contradicted by the thesis's own numbers"
    """Other printed numbers of the thesis give another result."""
    CLAIM_HOLDS = "claim tested on other data: holds"
    """A claim of the thesis about its recordings also holds on other captures."""
    CLAIM_FAILS = "claim tested on other data: fails"
    """A claim of the thesis about its recordings does not hold on other captures."""
    GIVEN = "given"
    """Input data, a diagram or a photograph, which need no computation."""
    ADDED = "added"
    """Item that is not in the thesis."""


@dataclass(frozen=True)
class Table:
    """Table of printed and recomputed values.

    Attributes:
        key: "5" for Table 5 of the thesis; the name of an added table.
        title: Caption.
        columns: Headings.
        rows: Cells of each row.
        verdict: Verdict on the reproduction.
        reason: Reason for differences from the printed values, or basis of the agreement.
        free: Number of free parameters of a fit; 0 without a fit.
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
    """Figure with recomputed curves.

    Attributes:
        key: "19" for Figure 19 of the thesis.
        title: Caption.
        svg: The plot, one ``<svg>`` element; empty for a diagram or photograph.
        verdict: Verdict on the reproduction.
        reason: Content, and reason for differences from the printed figure.
    """

    key: str
    title: str
    svg: str
    verdict: Reproduction
    reason: str

    kind: str = field(default="Figure", init=False)


Item = Table | Figure


def name(item: Item) -> str:
    """Return the name of an item, such as Table 5 or Figure 19; for an added item, its key."""
    return item.key if item.verdict is Reproduction.ADDED else f"{item.kind} {item.key}"


def label(item: Item) -> str:
    """Return the verdict as text, for a fit with its number of free parameters."""
    if item.verdict is Reproduction.FITTED and isinstance(item, Table):
        return f"{item.verdict.value}, {item.free} free parameters"
    return item.verdict.value
