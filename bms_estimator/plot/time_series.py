"""Plots of quantities over time."""

from typing import Any

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.plot.style import (
    BAND_LABEL,
    COLORS,
    FAINT,
    MEASURED,
    MIN_CURRENT_SPAN_A,
    MIN_SOC_SPAN_PERCENT,
    MIN_TEMPERATURE_SPAN_K,
    MIN_VOLTAGE_SPAN_V,
    MODEL,
    draw_band,
    new_axes,
    widen,
)
from bms_estimator.plot.thinning import thin

LINEAR_MV = 20.0
"""Error up to which a logarithmic axis of errors is linear [mV]."""
MAX_LINEAR_MV = 100.0
"""Largest error of a plot with a linear axis [mV]. On a linear axis, larger errors, such as those near empty, would hide all
others."""
MIN_ERROR_SPAN_MV = 1.0
"""Minimum span of an axis of errors [mV]."""
TIME_UNITS = ((3.0 * 86_400.0, 86_400.0, "days"), (7_200.0, 3_600.0, "h"), (180.0, 60.0, "min"), (0.0, 1.0, "s"))
"""Minimum duration [s], length [s] and name of each unit of the time axis."""


def voltage(time_s: Floats, measured_v: Floats, modeled_v: Floats | None = None, *, ax: Any = None) -> Any:
    """Draw the measured voltage and, if given, the modeled voltage.

    Args:
        time_s: Shape (n,), increasing [s].
        measured_v: Shape (n,) [V].
        modeled_v: Shape (n,) [V]; None: only the measured voltage is drawn.
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    if modeled_v is None:
        ax.plot(*_thin_over_time(time_s, measured_v), color=COLORS[0], linewidth=1.0)
    else:
        time, measured, modeled = _thin_over_time(time_s, measured_v, modeled_v)
        ax.plot(time, measured, label="measured", **MEASURED)
        ax.plot(time, modeled, label="model", **MODEL)
        _legend_above(ax)
    return label_axes(ax, time_s, "voltage [V]", MIN_VOLTAGE_SPAN_V)


def voltage_error(time_s: Floats, error_v: Floats, *, ax: Any = None) -> Any:
    """Draw the error of a modeled voltage, measured less modeled. Large errors are on a logarithmic scale.

    Args:
        time_s: Shape (n,), increasing [s].
        error_v: Shape (n,) [V].
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    error_mv = 1e3 * error_v
    ax.plot(*_thin_over_time(time_s, error_mv), color=COLORS[1], linewidth=0.8)
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    label_axes(ax, time_s, "measured minus model [mV]", MIN_ERROR_SPAN_MV)
    if float(np.abs(error_mv).max(initial=0.0)) > MAX_LINEAR_MV:
        ax.set_yscale("symlog", linthresh=LINEAR_MV)
        ax.axhspan(
            -LINEAR_MV, LINEAR_MV, color=FAINT, alpha=0.12, lw=0.0, label=f"linear scale up to ±{LINEAR_MV:g} mV"
        )
        ax.yaxis.set_major_formatter("{x:g}")
        _legend_above(ax)
    return ax


def soc(
    time_s: Floats, soc: Floats, soc_std: Floats | None = None, *, counted: Floats | None = None, ax: Any = None
) -> Any:
    """Draw the estimated SOC with its band of ±2 standard deviations.

    Args:
        time_s: Shape (n,), increasing [s].
        soc: Shape (n,), 0..1.
        soc_std: Shape (n,), standard deviation of ``soc``; None: without a band.
        counted: Shape (n,), SOC by coulomb counting; None: not drawn.
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    std = np.zeros(soc.size) if soc_std is None else np.nan_to_num(soc_std)
    low, high = (soc - 2.0 * std).clip(0.0, 1.0), (soc + 2.0 * std).clip(0.0, 1.0)
    curves = [soc, low, high] if counted is None else [soc, low, high, counted]
    time, estimated, low, high, *counted_curve = _thin_over_time(time_s, *(100.0 * curve for curve in curves))
    if soc_std is not None:
        draw_band(ax, time, low, high, label=BAND_LABEL)
    ax.plot(time, estimated, color=COLORS[0], label="estimated")
    for curve in counted_curve:
        ax.plot(time, curve, label="coulomb counting", **MODEL)
    _legend_above(ax)
    return label_axes(ax, time_s, "SOC [%]", MIN_SOC_SPAN_PERCENT)


def current(time_s: Floats, current_a: Floats, *, ax: Any = None) -> Any:
    """Draw the current, positive on discharge, as constant until the next sample.

    Args:
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,) [A].
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    ax.plot(*_thin_over_time(time_s, current_a), color=COLORS[2], linewidth=0.8, drawstyle="steps-post")
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    return label_axes(ax, time_s, "current [A], discharge > 0", MIN_CURRENT_SPAN_A)


def temperature(time_s: Floats, temperature_c: Floats, *, ax: Any = None) -> Any:
    """Draw the temperature.

    Args:
        time_s: Shape (n,), increasing [s].
        temperature_c: Shape (n,) [°C]; NaN where it was not measured.
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    ax.plot(*_thin_over_time(time_s, temperature_c), color=COLORS[3], linewidth=1.0)
    return label_axes(ax, time_s, "temperature [°C]", MIN_TEMPERATURE_SPAN_K)


def time_unit(time_s: Floats) -> tuple[float, str]:
    """Return length [s] and name of the unit of the time axis of ``time_s``."""
    duration_s = float(time_s[-1] - time_s[0]) if time_s.size else 0.0
    return next((length_s, name) for minimum_s, length_s, name in TIME_UNITS if duration_s >= minimum_s)


def label_axes(ax: Any, time_s: Floats, label: str, min_span: float) -> Any:
    """Label the axes of a plot over ``time_s``; ``label`` names the vertical axis of at least ``min_span``. Return the axes."""
    ax.set(xlabel=f"time [{time_unit(time_s)[1]}]", ylabel=label)
    ax.margins(x=0.01)
    widen(ax, min_span)
    return ax


def _thin_over_time(time_s: Floats, *curves: Floats) -> tuple[Floats, ...]:
    """Return the thinned curves over the time since the first sample, in the unit of the time axis."""
    thinned_s, *thinned = thin(time_s, *curves)
    return ((thinned_s - thinned_s[:1]) / time_unit(time_s)[0], *thinned)


def _legend_above(ax: Any) -> None:
    """Place the legend above the axes, where it hides no line."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2)
