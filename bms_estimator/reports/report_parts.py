"""Parts of a report: numbers as text, plots as inline SVG, and the page.

The HTML is self-contained, without scripts and external resources. It is made from the Jinja2 templates in ``templates``.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bms_estimator.plot.style import STYLE
from bms_estimator.version import __version__

MINUTE_S, HOUR_S, DAY_S = 60.0, 3600.0, 86_400.0
MIN_IN_HOURS_S = 2.0 * HOUR_S
"""Shortest duration that is given in hours [s]."""
MIN_IN_DAYS_S = 2.0 * DAY_S
"""Shortest duration that is given in days [s]."""


def number(value: float, digits: int = 4) -> str:
    """Format a number for tables with significant digits and, if possible, without exponent."""
    if value != value:  # NaN  # noqa: PLR0124
        return "-"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-4 <= abs(value) < 1e9:
        text = f"{value:.{max(digits - 1, 0)}f}" if abs(value) < 1 else f"{value:.0f}"
    return text


def percent(value: float, true: float) -> str:
    """Format the error of ``value`` in percent of the true value (erratum 7)."""
    error = 100.0 * abs(value - true) / abs(true)
    return "0" if error < 1e-4 else number(error, 3)


def duration_text(duration_s: float) -> str:
    """Return a duration in minutes, hours or days."""
    if duration_s < MIN_IN_HOURS_S:
        minutes = round(duration_s / MINUTE_S)
        return f"{minutes} minute{'s' if minutes != 1 else ''}"
    if duration_s < MIN_IN_DAYS_S:
        return f"{duration_s / HOUR_S:.1f} hours"
    return f"{duration_s / DAY_S:.1f} days"


WIDTH_IN = 8.0
"""Width of a figure [inches]."""
ROW_IN = 3.0
"""Height of a row of a figure [inches]."""
MARGIN_IN = 0.3
"""Height of a figure above its rows [inches]."""
SMALL_WIDTH_IN = 4.4
"""Width of a small figure [inches]. Its texts are readable on a phone and in two columns on paper."""
SMALL_HEIGHT_IN = 2.7
"""Height of a small figure [inches]."""


def small_plot(draw: Callable[[Any], object], *, salt: str) -> str:
    """Return a figure with one plot as an ``<svg>`` element, for pages with several columns of figures."""
    return _svg(draw, 1, 1, (SMALL_WIDTH_IN, SMALL_HEIGHT_IN), salt)


def plot(draw: Callable[[Any], None], *, rows: int = 1, columns: int = 1, salt: str = "bms") -> str:
    """Return a figure as an ``<svg>`` element.

    Args:
        draw: Function that draws on the axes: one, or an array of rows x columns.
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        salt: Salt that makes the ids in the SVG unique on the page and reproducible.
    """
    return _svg(draw, rows, columns, (WIDTH_IN, MARGIN_IN + ROW_IN * rows), salt)


def _svg(draw: Callable[[Any], object], rows: int, columns: int, size_in: tuple[float, float], salt: str) -> str:
    import matplotlib as mpl  # noqa: PLC0415  (an optional dependency)
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    settings: Any = STYLE | {"svg.hashsalt": salt}
    with mpl.rc_context(settings):
        figure = Figure(figsize=size_in)
        FigureCanvasSVG(figure)
        draw(figure.subplots(rows, columns))
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


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
