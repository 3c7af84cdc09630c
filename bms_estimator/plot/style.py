"""Colors and style of all plots, bands, thinned curves, and new axes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats

MAX_POINTS = 1200
"""Maximum number of points on a line. More points are not visible at the width of a figure."""
MIN_STEP = 0.05
"""Minimum change between two samples that counts as a step, as a fraction of the curve's range. A step whose first sample
is missing would be drawn as a ramp."""


def thin(x: Floats, *curves: Floats, points: int = MAX_POINTS) -> tuple[Floats, ...]:
    """Reduce the points of curves. The extremes and the largest steps remain.

    An increasing abscissa is divided into intervals of equal width; otherwise the samples are divided into intervals of equal
    size. The first sample of each interval remains, and so do the samples with the minimum and the maximum of each curve.
    Both samples of the largest steps remain, too. NaN is neither a minimum nor a maximum.

    Args:
        x: Shape (n,), common abscissa.
        *curves: Each of shape (n,).
        points: Approximate number of points of the result, which are at most ``1.5 * points + 1``.

    Returns:
        Abscissa and curves, all of the same reduced length.
    """
    if x.size <= points:
        return (x, *curves)
    kept = kept_indices(x, curves, points)
    return (x[kept], *(curve[kept] for curve in curves))


def kept_indices(x: Floats, curves: tuple[Floats, ...], points: int) -> NDArray[np.int64]:
    """Return the increasing indices of the samples that ``thin`` keeps."""
    size = x.size
    first = _first_indices(x, max(points // (1 + 2 * len(curves)), 1))
    last = np.append(first[1:], size)
    indices = [first, np.array([size - 1]), _step_indices(curves, points // 4)]
    for curve in curves:
        for find, missing in ((np.argmin, np.inf), (np.argmax, -np.inf)):
            intervals = (np.nan_to_num(curve[a:b], nan=missing) for a, b in zip(first, last, strict=True))
            indices.append(first + [find(values) for values in intervals])
    return np.unique(np.concatenate(indices))


def _first_indices(x: Floats, intervals: int) -> NDArray[np.int64]:
    """Return the increasing indices of the first sample of each interval; intervals without a sample have none."""
    if (x[1:] >= x[:-1]).all():
        return np.unique(np.searchsorted(x, np.linspace(x[0], x[-1], intervals + 1)[:-1]))
    return np.linspace(0, x.size, intervals, endpoint=False).astype(np.int64)


def _step_indices(curves: tuple[Floats, ...], max_steps: int) -> NDArray[np.int64]:
    """Return the indices of both samples of the largest steps of all curves, in any order."""
    begins, sizes = [], []
    for curve in curves:
        values = curve[np.isfinite(curve)]
        spread = np.ptp(values) if values.size else 0.0
        with np.errstate(invalid="ignore"):  # infinite values
            changes = np.nan_to_num(np.abs(np.diff(curve)), posinf=0.0)
        begins.append(np.flatnonzero(changes > MIN_STEP * spread))
        sizes.append(changes[begins[-1]] / spread)
    largest = np.concatenate(begins)[np.argsort(-np.concatenate(sizes), kind="stable")[:max_steps]]
    return np.concatenate([largest, largest + 1])


INK = "#1d2733"
"""Color of texts and ticks."""
FAINT = "#8a97a6"
"""Color of axes and secondary lines."""
COLORS = ("#1f5fa8", "#d1602b", "#2f8f5b", "#8a4fa3", "#b08a1e", "#4aa3b5")
"""Colors that differ in print and for color-blind readers: blue, orange, green, violet, ochre, teal."""
BAND_ALPHA = 0.2
"""Opacity of a band."""
BAND_LABEL = "±2 std"
"""Text of a band of ±2 standard deviations in a legend."""
MEASURED: dict[str, Any] = {"color": COLORS[0], "alpha": 0.45, "linewidth": 2.4}
"""Style of measured values: a wide light line, on which the model's values remain visible."""
MODEL: dict[str, Any] = {"color": COLORS[1], "linestyle": "--", "linewidth": 1.1}
"""Style of a model's values."""

MIN_VOLTAGE_SPAN_V = 0.01
"""Minimum span of an axis of voltages [V]. On a smaller axis the resolution of a sensor would look like a signal."""
MIN_CURRENT_SPAN_A = 0.01
"""Minimum span of an axis of currents [A]."""
MIN_TEMPERATURE_SPAN_K = 1.0
"""Minimum span of an axis of temperatures [K]."""
MIN_SOC_SPAN_PERCENT = 1.0
"""Minimum span of an axis of SOC [%]."""

STYLE: Any = {
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
    "axes.formatter.useoffset": False,
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
"""Settings of matplotlib by name. The type is Any, because matplotlib's stubs accept only a literal with known names."""


def draw_band(ax: Any, x: Floats, low: Floats, high: Floats, *, color: str = COLORS[0], label: str = "") -> None:
    """Draw the band between two curves, with an entry in the legend if it has a label."""
    ax.fill_between(x, low, high, color=color, alpha=BAND_ALPHA, lw=0.0, label=label or None)


def widen(ax: Any, min_span: float) -> None:
    """Widen the vertical axis to a minimum span, in the unit of the axis. Call it after the curves are drawn."""
    low, high = ax.get_ylim()
    if (missing := min_span - (high - low)) > 0.0:
        ax.set_ylim(low - missing / 2.0, high + missing / 2.0)


def new_axes() -> Any:
    """Return the axes of a new figure of pyplot."""
    from matplotlib import pyplot as plt  # noqa: PLC0415 - optional

    # The first figure loads the backend, which in a notebook changes rcParams. Within rc_context the change would be lost.
    figure = plt.figure(layout="constrained")
    with plt.rc_context(STYLE):
        return figure.subplots()
