"""Plots over time, and of a cell's properties over SOC: circuit elements, RC products and open-circuit voltage.

Numbers in parentheses are equations of the thesis.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS, c_tl, c_ts, delta, r_s, r_tl, r_ts
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import TableOcv
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
    thin,
    widen,
)

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


SOC_GRID = np.linspace(0.0, 1.0, OCV_POINTS)
"""SOCs at which curves are drawn."""
SOC_BINS = 50
"""Number of SOC intervals over which estimates are averaged."""
VISIBLE_SOC = 0.1
"""Lowest SOC whose values determine the range of the vertical axis. Resistances of many cells rise tenfold below."""
HEADROOM = 1.8
"""Range of the vertical axis relative to the largest value above ``VISIBLE_SOC``."""
ELEMENTS = {
    "r_s": (r_s, 1e3, "R_s [mΩ]"),
    "r_ts": (r_ts, 1e3, "R_ts [mΩ]"),
    "r_tl": (r_tl, 1e3, "R_tl [mΩ]"),
    "c_ts": (c_ts, 1.0, "C_ts [F]"),
    "c_tl": (c_tl, 1.0, "C_tl [F]"),
}
"""Function, scale and axis label of each circuit element, (2.5)-(2.9)."""
PAIRS = {"ts": (r_ts, c_ts, "R_ts · C_ts [s]"), "tl": (r_tl, c_tl, "R_tl · C_tl [s]")}
"""Resistance, capacitance and axis label of each RC pair."""


class SocCurve(NamedTuple):
    """Estimates over SOC with their standard deviations. All arrays have shape (n,)."""

    soc: Floats
    value: Floats
    std: Floats


def element(cell: CellModel, name: str, estimates: Mapping[str, Floats] | None = None, *, ax: Any = None) -> Any:
    """Draw a circuit element over SOC: the cell's curve and the estimates with a band of ±2 standard deviations.

    For a capacitance, a vertical line marks the SOC below which (2.7) or (2.8) is negative, if there is one.

    Args:
        cell: Cell whose curve is drawn.
        name: ``r_s``, ``r_ts``, ``r_tl``, ``c_ts`` or ``c_tl``.
        estimates: Columns of the result of ``estimate``; None: only the cell's curve.
        ax: Axes; None: a new figure is created.
    """
    function, scale, label = ELEMENTS[name]
    curve = scale * np.array([function(x, cell.a[:16]) for x in SOC_GRID])
    estimated = None if estimates is None else element_over_soc(estimates, name)
    ax = _draw_over_soc(ax or new_axes(), curve, estimated, scale)
    limit = stability_limits(cell).get(name, 0.0)
    if limit > 0.0:
        ax.axvline(100.0 * limit, color=FAINT, linestyle="-.", linewidth=1.0, label="stability limit")
    ax.set(ylabel=label)
    ax.legend(loc="best")
    return ax


def rc_product(cell: CellModel, pair: str, estimates: Mapping[str, Floats] | None = None, *, ax: Any = None) -> Any:
    """Draw the time constant of an RC pair over SOC: the cell's curve and the estimates with a band of ±2 std.

    Args:
        cell: Cell whose curve is drawn.
        pair: ``ts`` or ``tl``.
        estimates: Columns of the result of ``estimate``; None: only the cell's curve.
        ax: Axes; None: a new figure is created.
    """
    resistance, capacitance, label = PAIRS[pair]
    curve = np.array([resistance(x, cell.a[:16]) * capacitance(x, cell.a[:16]) for x in SOC_GRID])
    estimated = None if estimates is None else over_soc(estimates, f"tau_{pair}_s", f"tau_{pair}_std_s")
    ax = _draw_over_soc(ax or new_axes(), curve, estimated, 1.0)
    ax.set(ylabel=label)
    ax.legend(loc="best")
    return ax


def ocv(cell: CellModel, soc: Floats | None = None, ocv_v: Floats | None = None, *, ax: Any = None) -> Any:
    """Draw the open-circuit voltage over SOC, with a band of ±2 standard deviations and measured points if given.

    Args:
        cell: Cell whose curve is drawn.
        soc: Shape (n,), SOC of the measured points, 0..1.
        ocv_v: Shape (n,), measured open-circuit voltage [V].
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    curve_v = ocv_grid(cell)[0]
    std_v = ocv_std(cell)
    if std_v is not None:
        draw_band(ax, 100.0 * SOC_GRID, curve_v - 2.0 * std_v, curve_v + 2.0 * std_v, label=BAND_LABEL)
    ax.plot(100.0 * SOC_GRID, curve_v, color=COLORS[0], label=f"OCV of {cell.cell.name}")
    if soc is not None and ocv_v is not None:
        ax.plot(100.0 * soc, ocv_v, "o", color=COLORS[1], markersize=3.5, label="rests")
    ax.set(xlabel="SOC [%]", ylabel="open-circuit voltage [V]")
    ax.legend(loc="best")
    return ax


def ocv_residuals(cell: CellModel, soc: Floats, residual_v: Floats, *, ax: Any = None) -> Any:
    """Draw measured less modeled open-circuit voltage over SOC, with the curve's band of ±2 standard deviations.

    Args:
        cell: Cell whose curve was subtracted.
        soc: Shape (n,), 0..1.
        residual_v: Shape (n,) [V].
        ax: Axes; None: a new figure is created.
    """
    ax = ax or new_axes()
    std_v = ocv_std(cell)
    if std_v is not None:
        draw_band(ax, 100.0 * SOC_GRID, -2e3 * std_v, 2e3 * std_v, label=f"{BAND_LABEL} of the curve")
        ax.legend(loc="best")
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    ax.plot(100.0 * soc, 1e3 * residual_v, "o", color=COLORS[1], markersize=3.5)
    limit_mv = 1.3e3 * float(np.abs(residual_v).max(initial=1e-3))  # with a margin of 30 %
    ax.set(xlabel="SOC [%]", ylabel="rests minus OCV [mV]", ylim=(-limit_mv, limit_mv))
    return ax


def stability_limits(cell: CellModel) -> dict[str, float]:
    """Return the SOCs below which C_ts and C_tl of the cell are negative, (2.11) and (2.12)."""
    a = cell.a
    return {"c_ts": float(delta(a[8], a[9], a[7])), "c_tl": float(delta(a[11], a[12], a[10]))}


def ocv_std(cell: CellModel) -> Floats | None:
    """Return the standard deviation of the OCV at ``SOC_GRID`` [V]; None if the cell file has none."""
    if not isinstance(cell.ocv, TableOcv) or cell.ocv.error_v is None:
        return None
    return np.interp(SOC_GRID, cell.ocv.soc, cell.ocv.error_v)


def element_over_soc(estimates: Mapping[str, Floats], name: str) -> SocCurve:
    """Return the estimates of a circuit element over SOC [ohm or F]. A capacitance is the time constant over R."""
    if name.startswith("r_"):
        return over_soc(estimates, f"{name}_ohm", f"{name}_std_ohm")
    pair = name.removeprefix("c_")
    resistance = over_soc(estimates, f"r_{pair}_ohm", f"r_{pair}_std_ohm")
    tau = over_soc(estimates, f"tau_{pair}_s", f"tau_{pair}_std_s")
    capacitance = tau.value / resistance.value
    return SocCurve(
        resistance.soc, capacitance, capacitance * np.hypot(tau.std / tau.value, resistance.std / resistance.value)
    )


def over_soc(estimates: Mapping[str, Floats], value: str, std: str) -> SocCurve:
    """Return the means of two columns of estimates in intervals of SOC; intervals without estimates are omitted."""
    values, stds = estimates[value], estimates[std]
    valid = np.isfinite(values) & np.isfinite(stds)
    bins = np.clip((estimates["soc"][valid] * SOC_BINS).astype(np.int64), 0, SOC_BINS - 1)
    count = np.bincount(bins, minlength=SOC_BINS)
    filled = count > 0
    means = (np.bincount(bins, column[valid], SOC_BINS)[filled] / count[filled] for column in (values, stds))
    return SocCurve((np.flatnonzero(filled) + 0.5) / SOC_BINS, *means)


def _draw_over_soc(ax: Any, curve: Floats, estimated: SocCurve | None, scale: float) -> Any:
    """Draw a cell's curve, already scaled, at ``SOC_GRID``, and estimates times ``scale``."""
    ax.plot(100.0 * SOC_GRID, curve, label="cell file", **MODEL)
    visible = [curve[SOC_GRID >= VISIBLE_SOC]]
    if estimated is not None and estimated.soc.size:
        value, band = scale * estimated.value, 2.0 * scale * estimated.std
        draw_band(ax, 100.0 * estimated.soc, value - band, value + band, label=BAND_LABEL)
        ax.plot(100.0 * estimated.soc, value, color=COLORS[0], label="estimated")
        visible.append(value[estimated.soc >= VISIBLE_SOC])
    largest = max(float(values.max(initial=0.0)) for values in visible)
    ax.set(xlabel="SOC [%]", xlim=(0.0, 100.0), ylim=(0.0, HEADROOM * largest) if largest > 0.0 else None)
    return ax
