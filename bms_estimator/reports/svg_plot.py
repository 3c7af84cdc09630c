"""Plots as inline SVG (matplotlib)."""

import io
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from bms_estimator.model.arrays import Floats

INK = "#1d2733"
"""Color of texts and ticks."""
FAINT = "#8a97a6"
"""Color of axes and secondary lines."""
COLORS = ("#1f5fa8", "#d1602b", "#2f8f5b", "#8a4fa3", "#b08a1e", "#4aa3b5")
"""Colors that differ in print and for color-blind readers: blue, orange, green, violet, ochre, teal."""
MAX_POINTS = 1200
"""Maximum number of points on a line. More points are not visible at the width of a figure."""
WIDTH_IN = 8.0
"""Width of a figure [inches]."""
ROW_IN = 3.0
"""Height of a row of a figure [inches]."""

STYLE: dict[str, Any] = {
    "svg.fonttype": "path",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6eaef",
    "grid.linewidth": 0.7,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "lines.linewidth": 1.4,
    "figure.constrained_layout.use": True,
    "axes.prop_cycle": f"cycler('color', {list(COLORS)})",
}


def plot(draw: Callable[[Any], None], *, rows: int = 1, columns: int = 1, salt: str = "bms") -> str:
    """Return a figure as an ``<svg>`` element.

    Args:
        draw: Function that draws on the axes: one, or an array of rows x columns.
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        salt: Salt that makes the ids in the SVG unique on the page and reproducible.
    """
    import matplotlib as mpl  # noqa: PLC0415  (an optional dependency)
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    settings: Any = STYLE | {"svg.hashsalt": salt}
    with mpl.rc_context(settings):
        figure = Figure(figsize=(WIDTH_IN, 0.3 + ROW_IN * rows))
        FigureCanvasSVG(figure)
        draw(figure.subplots(rows, columns))
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def thin(x: Floats, *curves: Floats, points: int = MAX_POINTS) -> tuple[Floats, ...]:
    """Reduce the points of curves to the first, lowest and highest point of the first curve in each interval."""
    if x.size <= points:
        return (x, *curves)
    y = curves[0]
    edges = np.linspace(0, x.size, points // 3 + 1).astype(int)
    indices = {x.size - 1}
    for first, last in itertools.pairwise(edges):
        interval_y = y[first:last]
        indices |= {int(first), int(first + np.argmin(interval_y)), int(first + np.argmax(interval_y))}
    order = np.array(sorted(indices))
    return (x[order], *(curve[order] for curve in curves))
