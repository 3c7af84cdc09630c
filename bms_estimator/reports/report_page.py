"""Page of a report on captures or on a pack's history: verdict, sections, figures and tables."""

from dataclasses import dataclass

from bms_estimator.reports.html import render

Rows = tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Plot:
    """Figure of a report: one ``<svg>`` element, and a title for screen readers."""

    title: str
    svg: str


@dataclass(frozen=True)
class Group:
    """Figures or a table under a common heading.

    Attributes:
        title: Heading.
        figures: Figures.
        columns: Headings of the table; empty without a table.
        rows: Cells of each row of the table.
        is_text: True if the cells are left-aligned texts that wrap.
        remark: Explanation below.
    """

    title: str
    figures: tuple[Plot, ...] = ()
    columns: tuple[str, ...] = ()
    rows: Rows = ()
    is_text: bool = False
    remark: str = ""


@dataclass(frozen=True)
class Section:
    """Section of a report, for example on one capture."""

    title: str
    sentences: tuple[str, ...]
    warnings: tuple[str, ...]
    groups: tuple[Group, ...]


@dataclass(frozen=True)
class ReportPage:
    """Contents of a report.

    Attributes:
        title: Title of the page.
        subtitle: Line below the title.
        grade: Grade of the model, ``good``, ``fair`` or ``poor``; empty without a grade.
        sentences: Sentences of the verdict.
        sections: Sections in order.
        written: Time at which the report was written.
    """

    title: str
    subtitle: str
    grade: str
    sentences: tuple[str, ...]
    sections: tuple[Section, ...]
    written: str

    def html(self) -> str:
        """Return the page as HTML."""
        return render("report.html", page=self)
