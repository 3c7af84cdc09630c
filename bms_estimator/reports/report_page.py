"""Page of a report on captures or on a pack's history: verdict, sections, figures and tables.

The HTML is self-contained, without scripts and external resources. It is made from the Jinja2 templates in ``templates``.
"""

from dataclasses import dataclass

from bms_estimator.version import __version__


def render(template: str, **values: object) -> str:
    """Return a page.

    Args:
        template: File name in ``templates``.
        **values: Values of the template. Their texts are escaped, except SVG, which the templates mark as safe.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415 - optional

    environment = Environment(
        loader=PackageLoader("bms_estimator.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values)


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
