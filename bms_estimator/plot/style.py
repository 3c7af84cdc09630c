"""Colors and style of all plots, bands, and new axes."""

from typing import Any

from bms_estimator.model.arrays import Floats

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
