"""Plots of a forecast over the time ahead: SOC and voltage, each as median with its 90 % interval."""

from typing import Any

from bms_estimator.forecast.available_power import ForecastCurve
from bms_estimator.plot.cell_curves import label_axes, time_unit
from bms_estimator.plot.style import COLORS, FAINT, MIN_SOC_SPAN_PERCENT, MIN_VOLTAGE_SPAN_V, draw_band, new_axes

INTERVAL_LABEL = "90 % interval"
"""Text of the interval in the legend."""


def soc_ahead(curve: ForecastCurve, *, ax: Any = None) -> Any:
    """Draw the SOC, and the probability that the cut-off comes later.

    Args:
        curve: Curves of a forecast.
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    ahead = curve.elapsed_s / time_unit(curve.elapsed_s)[0]
    draw_band(ax, ahead, 100.0 * curve.soc_p05, 100.0 * curve.soc_p95, label=INTERVAL_LABEL)
    ax.plot(ahead, 100.0 * curve.soc_p50, color=COLORS[0], label="SOC, median")
    ax.plot(ahead, 100.0 * curve.survival, color=COLORS[1], linestyle="--", label="probability of no cut-off yet")
    ax.legend(loc="best")
    return label_axes(ax, curve.elapsed_s, "SOC, probability [%]", MIN_SOC_SPAN_PERCENT)


def voltage_ahead(curve: ForecastCurve, cutoff_v: float, *, ax: Any = None) -> Any:
    """Draw the terminal voltage and the cut-off voltage.

    Args:
        curve: Curves of a forecast.
        cutoff_v: Voltage at which the load is switched off [V].
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    ahead = curve.elapsed_s / time_unit(curve.elapsed_s)[0]
    draw_band(ax, ahead, curve.voltage_p05_v, curve.voltage_p95_v, color=COLORS[2], label=INTERVAL_LABEL)
    ax.plot(ahead, curve.voltage_p50_v, color=COLORS[2], label="voltage, median")
    ax.axhline(cutoff_v, color=FAINT, linewidth=0.8, label=f"cut-off {cutoff_v:.4g} V")
    ax.legend(loc="best")
    return label_axes(ax, curve.elapsed_s, "voltage [V]", MIN_VOLTAGE_SPAN_V)
