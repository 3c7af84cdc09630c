"""Figures 26 to 38 and 40 to 42 of the thesis: results of the procedure of chapter 5.

Numbers in parentheses are equations of the thesis, and E1 to E37 are its errata (``errata``).
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from bms_estimator.calibration.ocv.chen_mora_fit import chen_mora
from bms_estimator.plot.style import COLORS, FAINT, thin
from bms_estimator.reports.report_parts import plot
from bms_estimator.reports.thesis import printed_values
from bms_estimator.reports.thesis.experiment import Experiment
from bms_estimator.reports.thesis.observer_plots import crossing_plot, dynamic_static_plot, elements_plot, products_plot
from bms_estimator.reports.thesis.procedure import Capture, Kind, Procedure
from bms_estimator.reports.thesis.report_items import Figure, Reproduction
from bms_estimator.reports.thesis.simulation import SOC_GRID

MAX_LOADS = 4
"""Maximum number of loads in a figure, as in Fig. 32."""


def _figure(
    key: str, title: str, svg: str, experiment: Experiment, reason: str, *, claims: tuple[str, ...] = ()
) -> Figure:
    verdict, tested = experiment.verdict_on_claims(*claims) if claims else (Reproduction.NO_DATA, "")
    return Figure(key, title, svg, verdict, f"{experiment.data_note} {tested}{reason}")


def figure_26(experiment: Experiment) -> Figure:
    """Draw the open-circuit voltage E_o over SOC."""
    p = experiment.procedure

    def draw(axes: Any) -> None:
        grid = np.linspace(0.0, 1.0, 600)
        for color, test in zip(np.resize(COLORS, len(p.tests)), p.tests, strict=True):
            axes[0].errorbar(test.soc, test.ocv_v, 2.0 * test.std_v, fmt="o", ms=3, color=color, label=test.name)
        if experiment.recorded is None:  # Table 8 describes the simulated pack, not a recorded one
            axes[0].plot(
                grid, chen_mora(np.array(printed_values.TABLE_8), grid), ":", linewidth=2.4, label="(2.10), Table 8"
            )
        axes[0].plot(grid, p.joint_fit(grid), color="black", linewidth=1.0, label="(2.10), joint fit")
        axes[0].plot(grid, p.table(grid), color=FAINT, linewidth=1.0, label="table")
        axes[0].set(xlabel="SOC", ylabel="E_o [V]")
        axes[0].legend(loc="best")
        for color, test in zip(np.resize(COLORS, len(p.tests)), p.tests, strict=True):
            axes[1].plot(test.soc, 1e3 * (test.ocv_v - p.joint_fit(test.soc)), "o", ms=3, color=color)
        axes[1].axhline(0.0, color=FAINT, linewidth=0.8)
        axes[1].set(xlabel="SOC", ylabel="mV", title="points minus (2.10)")

    return _figure(
        "26",
        "E_o over SOC from voltage relaxation tests",
        plot(draw, columns=2, salt="figure-26"),
        experiment,
        "Bars: two standard deviations of the extrapolation to infinite rest."
        + (" Dotted: the printed curve, from Table 8." if experiment.recorded is None else ""),
    )


def figure_27(experiment: Experiment) -> Figure:
    """Draw the currents of the relaxation tests."""
    tests = experiment.procedure.captures_of(Kind.RELAXATION)
    return _figure("27", "Currents of the voltage relaxation tests", _currents(tests, "27"), experiment, "")


def _currents(captures: Sequence[Capture], key: str) -> str:
    """Return a figure of the currents of captures, one plot for each; empty without captures."""
    samples = {capture.name: capture.samples for capture in captures}

    def draw_current(ax: Any, name: str) -> None:
        hours, current = thin(samples[name]["time_s"] / 3600.0, samples[name]["current_a"], points=3000)
        ax.plot(hours, current, linewidth=0.8)
        ax.set(xlabel="time [h]", ylabel="A")

    return _plots_by_load(list(samples), draw_current, key)


def figure_28(experiment: Experiment) -> Figure:
    """Draw a8 and a11 over SOC with their stability conditions; without a plot if one is not met above SOC 0."""
    run = experiment.procedure.adaptive
    crossings = ", ".join(f"{c.parameter} at SOC {c.soc:.5f}" for c in run.crossings)
    is_complete = min(c.soc for c in run.crossings) > 0.0
    return _figure(
        "28",
        "a8 and a11 meet their stability conditions",
        plot(lambda axes: crossing_plot(axes, run), columns=2, salt="figure-28") if is_complete else "",
        experiment,
        f"{crossings}." if is_complete else f"Not every crossing is above SOC 0: {crossings}.",
    )


def figure_29(experiment: Experiment) -> Figure:
    """Draw the RC products."""
    run = experiment.procedure.adaptive
    return _figure(
        "29",
        "R_ts·C_ts and R_tl·C_tl as estimated",
        plot(lambda axes: products_plot(axes, None, run.average), columns=2, salt="figure-29"),
        experiment,
        "a1..a12 converge to limits that the bounds define (E3). The products are those of these limits.",
        claims=("RC products",),
    )


def figure_30(experiment: Experiment) -> Figure:
    """Draw the elements."""
    run = experiment.procedure.adaptive
    crossing_socs = [c.soc for c in run.crossings]
    return _figure(
        "30",
        "R_tl, R_ts, C_tl, C_ts with the stability conditions",
        plot(lambda axes: elements_plot(axes, None, run.average, crossing_socs), rows=2, columns=2, salt="figure-30"),
        experiment,
        "",
    )


def figure_31(experiment: Experiment) -> Figure:
    """Draw the series resistance R_s by (4.2)."""
    p, truth = experiment.procedure, experiment.truth

    def draw(axes: Any) -> None:
        for name, curve in p.r_s_curves.items():
            axes.plot(curve.soc, 1e3 * curve.r_s_ohm, label=name, linewidth=1.0)
        axes.plot(p.r_s_mean.soc, 1e3 * p.r_s_mean.r_s_ohm, "k", label="mean", linewidth=1.6)
        axes.plot(SOC_GRID, 1e3 * p.r_s_fit(SOC_GRID), "k--", label="fit (2.9)")
        if truth is not None:
            true = truth[13] * np.exp(-truth[14] * SOC_GRID) + truth[15]
            axes.plot(SOC_GRID, 1e3 * true, color=FAINT, linewidth=2.4, label="(2.9), Table 9")
        middle = 1e3 * float(np.median(p.r_s_mean.r_s_ohm))
        # sorted, because (4.2) can give a negative resistance
        axes.set(xlabel="SOC", ylabel="R_s [mΩ]", ylim=sorted((0.5 * middle, 1.5 * middle)))
        axes.legend(loc="best", ncols=2)

    return _figure(
        "31",
        "R_s by (4.2) for different loads",
        plot(draw, salt="figure-31"),
        experiment,
        "The sign of (4.2) is that of (2.4); the mean is weighted by the square of the current (E19)."
        + (" Grey: the printed curve, from Table 9." if truth is not None else ""),
    )


def constant_loads(p: Procedure) -> list[str]:
    """Return the names of the constant loads, at most ``MAX_LOADS``."""
    return [c.name for c in p.captures_of(Kind.CONSTANT)][:MAX_LOADS]


def step_loads(p: Procedure) -> list[str]:
    """Return the names of the first two loads that are not constant."""
    return [c.name for c in p.captures_of(Kind.STEPS)][:2]


def _largest_error(p: Procedure, names: list[str]) -> str:
    if not names:
        return "None of the captures is such a load."
    return f"Largest error {max(p.dynamic[name].max_percent for name in names):.2f} %."


def _plots_by_load(names: list[str], draw_load: Callable[[Any, str], None], key: str) -> str:
    """Return a figure with one plot for each load in ``names``, drawn by ``draw_load``; empty without loads."""
    if not names:
        return ""
    columns = 2 if len(names) > 1 else 1
    rows = math.ceil(len(names) / columns)

    def draw(axes: Any) -> None:
        flat = np.atleast_1d(axes).flat
        for ax, name in zip(flat, names, strict=False):
            draw_load(ax, name)
            ax.set_title(name)
        for ax in np.atleast_1d(axes).flat[len(names) :]:
            ax.set_axis_off()

    return plot(draw, rows=rows, columns=columns, salt=f"figure-{key}")


def _voltages(p: Procedure) -> Callable[[Any, str], None]:
    def draw_load(ax: Any, name: str) -> None:
        run = p.dynamic[name]
        t, y, yhat = thin(run.time_s / 3600.0, run.voltage_v, run.predicted_v)
        ax.plot(t, y, color=COLORS[0], alpha=0.45, linewidth=2.4, label="actual")
        ax.plot(t, yhat, "--", color=COLORS[1], label="estimated", linewidth=1.0)
        ax.set(xlabel="time [h]", ylabel="V")
        ax.legend(loc="best")

    return draw_load


def _errors(p: Procedure) -> Callable[[Any, str], None]:
    def draw_load(ax: Any, name: str) -> None:
        run = p.dynamic[name]
        t, e = thin(run.time_s / 3600.0, run.error_percent)
        ax.plot(t, e, linewidth=0.8)
        ax.set(xlabel="time [h]", ylabel="|e| [%]")

    return draw_load


def figure_32(experiment: Experiment) -> Figure:
    """Draw the voltages under constant loads."""
    svg = _plots_by_load(constant_loads(experiment.procedure), _voltages(experiment.procedure), "32")
    return _figure("32", "Constant loads: actual and estimated voltage", svg, experiment, "")


def _load_errors(
    key: str, kind: str, loads: Callable[[Procedure], list[str]], printed_percent: float, experiment: Experiment
) -> Figure:
    """Draw the errors under constant loads or steps."""
    p, names = experiment.procedure, loads(experiment.procedure)
    reason = f"{_largest_error(p, names)} Printed: at most {printed_percent:g} %."
    svg = _plots_by_load(names, _errors(p), key)
    return _figure(key, f"{kind}: error", svg, experiment, reason, claims=(f"{kind.lower()}, largest",))


def _load_currents(key: str, kind: str, loads: Callable[[Procedure], list[str]], experiment: Experiment) -> Figure:
    """Draw the currents of constant loads or steps."""
    p = experiment.procedure
    captures = [capture for capture in p.captures if capture.name in loads(p)]
    return _figure(key, f"{kind}: currents", _currents(captures, key), experiment, "")


def _step_voltage(key: str, kind: str, index: int, experiment: Experiment) -> Figure:
    """Draw the voltage under the steps with an index, or under the last ones."""
    p = experiment.procedure
    names = step_loads(p)[index : index + 1] or step_loads(p)[-1:]
    svg = _plots_by_load(names, _voltages(p), key)
    return _figure(key, f"{kind} steps: actual and estimated voltage", svg, experiment, _largest_error(p, names))


def figure_40(experiment: Experiment) -> Figure:
    """Draw the errors of the dynamic and the static model."""
    p = experiment.procedure
    name = (step_loads(p) or constant_loads(p))[-1]
    svg = plot(lambda axes: dynamic_static_plot(axes, p.dynamic[name], p.static[name]), columns=2, salt="figure-40")
    return _figure("40", f"Dynamic and static model on {name}", svg, experiment, "")


def figure_41(experiment: Experiment) -> Figure:
    """Draw the SOC by interpolation."""
    p = experiment.procedure
    run, (soc, _) = p.dynamic[p.largest_load], p.interpolate_soc(p.largest_load)
    rms = float(np.sqrt(np.mean((soc - run.soc) ** 2)))

    def draw(axes: Any) -> None:
        hours, counted, interpolated = thin(run.time_s / 3600.0, run.soc, soc)
        axes[0].plot(hours, counted, color=COLORS[0], alpha=0.45, linewidth=2.4, label="coulomb counting")
        axes[0].plot(hours, interpolated, "--", color=COLORS[1], linewidth=1.0, label="interpolation in E_o")
        axes[0].set(xlabel="time [h]", ylabel="SOC")
        axes[0].legend(loc="best")
        hours, difference = thin(run.time_s / 3600.0, 100.0 * (soc - run.soc))
        axes[1].plot(hours, difference, linewidth=0.9)
        axes[1].set(xlabel="time [h]", ylabel="% of SOC", title="interpolated minus counted")

    return _figure(
        "41",
        f"SOC by coulomb counting and by interpolation in E_o, {p.largest_load}",
        plot(draw, columns=2, salt="figure-41"),
        experiment,
        f"They differ by {100 * rms:.2f} % of SOC RMS.",
        claims=("SOC by interpolation",),
    )


def figure_42(experiment: Experiment) -> Figure:
    """Draw E_o over the counted and the interpolated SOC."""
    p = experiment.procedure
    run, (soc, e_o) = p.dynamic[p.largest_load], p.interpolate_soc(p.largest_load)

    def draw(axes: Any) -> None:
        x, y = thin(run.soc, e_o)
        axes.plot(x, y, color=COLORS[0], label="E_o = y + x2 + x3 + i R_s over counted SOC")
        x, y = thin(soc, e_o)
        axes.plot(x, y, "--", color=COLORS[1], label="over interpolated SOC")
        axes.set(xlabel="SOC", ylabel="V")
        axes.legend(loc="best")

    return _figure("42", f"E_o over SOC, {p.largest_load}", plot(draw, salt="figure-42"), experiment, "")


FIGURES: dict[str, Callable[[Experiment], Figure]] = {
    "26": figure_26,
    "27": figure_27,
    "28": figure_28,
    "29": figure_29,
    "30": figure_30,
    "31": figure_31,
    "32": figure_32,
    "33": partial(_load_errors, "33", "Constant loads", constant_loads, printed_values.MAX_CONSTANT),
    "34": partial(_load_currents, "34", "Constant loads", constant_loads),
    "35": partial(_step_voltage, "35", "Constant", 0),
    "36": partial(_load_currents, "36", "Steps", step_loads),
    "37": partial(_step_voltage, "37", "Variable", 1),
    "38": partial(_load_errors, "38", "Steps", step_loads, printed_values.MAX_STEPS),
    "40": figure_40,
    "41": figure_41,
    "42": figure_42,
}
