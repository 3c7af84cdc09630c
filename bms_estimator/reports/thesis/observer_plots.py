"""Plots of the adaptive observer that figures of simulations and of experiments share.

Numbers in parentheses are equations of the thesis, and E1 to E37 are its errata (``errata``).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun
from bms_estimator.calibration.thesis.prediction import Prediction
from bms_estimator.model.arrays import Floats
from bms_estimator.plot.style import COLORS, FAINT, thin
from bms_estimator.reports.thesis.simulation import (
    SOC_GRID,
    element,
)

NO_VALUES = "The thesis prints no value of the figure that could be compared."
"""Reason of a figure without printed values."""


def tracking_plot(run: AdaptiveRun, label: str) -> Callable[[Any], None]:
    """Return a function that draws measured and estimated voltage at run time."""

    def draw(axes: Any) -> None:
        t, y, yhat = thin(run.time_s / 60.0, run.voltage_v, run.voltage_estimate_v)
        axes.plot(t, y, label="y, true cell", linewidth=2.6, color=COLORS[0], alpha=0.45)
        axes.plot(t, yhat, "--", label=label, color=COLORS[1])
        axes.set(xlabel="time [min]", ylabel="V")
        axes.legend(loc="best")

    return draw


def error_plot(axes: Any, run: AdaptiveRun) -> None:
    """Draw the error e(t) at run time on logarithmic axes."""
    t, e = thin(run.time_s, 1e3 * run.error_v)
    axes.plot(np.maximum(t, 1e-2), e)
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=0.1)
    axes.axhline(0.0, color=FAINT, linewidth=0.8)
    axes.set(xlabel="time [s]", ylabel="e [mV]")


def frozen_plot(axes: Any, frozen: Prediction, label: str) -> None:
    """Draw the voltages of the frozen model and of the true cell."""
    t, y, yhat = thin(frozen.time_s / 60.0, frozen.voltage_v, frozen.predicted_v)
    axes.plot(t, y, label="y, true cell", linewidth=2.6, color=COLORS[0], alpha=0.45)
    axes.plot(t, yhat, "--", label=label, color=COLORS[1])
    axes.set(xlabel="time [min]", ylabel="V")
    axes.legend(loc="best")


def crossing_plot(axes: Any, run: AdaptiveRun) -> None:
    """Draw a8 and a11 over SOC with the bounds of their stability conditions, for Fig. 19 and 28."""
    settled = run.time_s >= run.window.t_int_s
    for ax, crossing in zip(axes, run.crossings, strict=True):
        i = int(crossing.parameter[1:])
        ax.plot(run.soc[settled], run.a[settled, i], label=f"$a_{{{i}}}$")
        condition_plot(ax, i, float(run.a[-1, i]), crossing.soc)


def condition_plot(ax: Any, i: int, value: float, crossing_soc: float) -> None:
    """Draw the bound above which a8 (a11) keeps C_ts (C_tl) positive, and the SOC at which ``value`` meets it."""
    low, high = 0.4 * max(crossing_soc, 1e-3), 12.0 * max(crossing_soc, 1e-3)
    soc = np.linspace(low, high, 400)
    ax.plot(soc, value * crossing_soc / soc, label=f"$-\\ln(a_{{{i + 1}}}/a_{{{i - 1}}})/x_1$")
    ax.axvline(crossing_soc, color=FAINT, linestyle="-.", linewidth=1.0)
    ax.annotate(f"  SOC {crossing_soc:.5f}", (crossing_soc, 1.7 * value), color=FAINT, fontsize=8)
    ax.set(xlabel="SOC (discharge from right to left)", xlim=(low, high), ylim=(0.0, 2.5 * value))
    ax.legend(loc="upper right")


def elements_plot(axes: Any, true: Floats | None, estimated: Floats, crossing_socs: Sequence[float]) -> None:
    """Draw four elements over SOC, with lines at delta1 and delta2, for Fig. 21 and 30."""
    soc = np.linspace(0.03, 1.0, 800)
    for ax, (name, unit) in zip(axes.flat, (("R_tl", "Ω"), ("R_ts", "Ω"), ("C_tl", "F"), ("C_ts", "F")), strict=True):
        if true is not None:
            ax.plot(soc, element(name, true, soc), label="Chen and Mora")
        ax.plot(soc, element(name, estimated, soc), "--", label="estimated")
        for crossing_soc, style in zip(crossing_socs, ("--", ":"), strict=True):
            ax.axvline(crossing_soc, color=FAINT, linestyle=style, linewidth=1.0)
        ax.set(xlabel="SOC", ylabel=unit, title=name, xlim=(0.0, 1.0))
        ax.legend(loc="best")


def products_plot(axes: Any, true: Floats | None, estimated: Floats) -> None:
    """Draw the RC products over SOC, for Fig. 20 and 29."""
    for ax, name in zip(axes, ("R_ts C_ts", "R_tl C_tl"), strict=True):
        if true is not None:
            ax.plot(SOC_GRID, element(name, true), label="Chen and Mora")
        ax.plot(SOC_GRID, element(name, estimated), "--", label="estimated")
        ax.set(xlabel="SOC", ylabel="s", title=name.replace(" ", " · "))
        ax.legend(loc="best")


def dynamic_static_plot(axes: Any, dynamic: Prediction, static: Prediction) -> None:
    """Draw the end of a run, and the errors over SOC, for Fig. 39 and 40."""
    late = dynamic.soc < 0.25
    t, y, dynamic_v, static_v = thin(
        dynamic.time_s[late] / 60.0, dynamic.voltage_v[late], dynamic.predicted_v[late], static.predicted_v[late]
    )
    axes[0].plot(t, y, color=COLORS[0], alpha=0.45, linewidth=2.6, label="actual")
    axes[0].plot(t, dynamic_v, "--", color=COLORS[1], label="dynamic")
    axes[0].plot(t, static_v, ":", color=COLORS[2], label="static")
    axes[0].set(xlabel="time [min]", ylabel="V", title="SOC below 0.25")
    axes[0].legend(loc="best")
    for run, label, color in ((static, "static", COLORS[2]), (dynamic, "dynamic", COLORS[1])):
        soc, e = thin(run.soc, 1e3 * run.error_v)
        axes[1].plot(soc, e, color=color, label=label, linewidth=1.0)
    axes[1].set(xlabel="SOC", ylabel="error [mV]", title="actual minus model")
    axes[1].invert_xaxis()
    axes[1].legend(loc="best")
