"""Plots as inline SVG (matplotlib)."""

import io
from collections.abc import Callable
from typing import Any

from bms_estimator.plot.style import STYLE

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
