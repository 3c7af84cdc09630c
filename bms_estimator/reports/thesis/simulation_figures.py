"""Figures 3 to 10, 13 to 17, 19 to 23 and 39 of the thesis, recomputed.

Numbers in parentheses are equations of the thesis, and E1 to E37 are its errata (``errata``).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun
from bms_estimator.calibration.thesis.prediction import Prediction
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, emf, r_s, r_tl, r_ts
from bms_estimator.kernels.observer.mittag_leffler import decay_table, mittag_leffler, series_coefficients
from bms_estimator.model.arrays import Floats
from bms_estimator.plot.style import COLORS, FAINT, thin
from bms_estimator.reports.report_parts import plot
from bms_estimator.reports.thesis.bank_figure import LOAD_C, WEAK_SOC, BankExperiment
from bms_estimator.reports.thesis.observer_plots import (
    NO_VALUES,
    crossing_plot,
    dynamic_static_plot,
    elements_plot,
    error_plot,
    frozen_plot,
    products_plot,
    tracking_plot,
)
from bms_estimator.reports.thesis.report_items import Figure, Reproduction
from bms_estimator.reports.thesis.simulation import (
    FINAL_SOC,
    SOC_GRID,
    STATIC_SOC,
    Simulation,
    mean_error_percent,
)
from bms_estimator.reports.thesis.theorem_4_1_2 import PRODUCTS

FULL_SOC_GRID = np.linspace(0.0, 1.0, 1001)
"""SOC grid over the full range."""


CURVES: dict[str, tuple[str, str, Callable[[float, Floats], float], tuple[float, float] | None]] = {
    "3": ("Open-circuit voltage E_o over SOC, (2.10)", "V", emf, None),
    "4": ("R_s over SOC, (2.9)", "Ω", r_s, None),
    "5": ("R_ts over SOC, (2.5)", "Ω", r_ts, None),
    "6": ("C_ts over SOC, (2.7)", "F", c_ts, None),
    "7": ("R_tl over SOC, (2.6)", "Ω", r_tl, (0.0, 0.5)),
    "8": ("C_tl over SOC, (2.8)", "F", c_tl, None),
}
"""Title, unit, function of SOC and parameters, and limits of the vertical axis of the figures of one curve, by number."""


def curve(key: str, s: Simulation) -> Figure:
    """Draw an element or the EMF of the cell over SOC."""
    title, unit, function, limits = CURVES[key]

    def draw(axes: Any) -> None:
        axes.plot(FULL_SOC_GRID, [function(x, s.cell.a) for x in FULL_SOC_GRID])
        axes.set(xlabel="SOC $x_1$", ylabel=unit, xlim=(0.0, 1.0), ylim=limits)

    reason = f"From Chen and Mora's parameters. {NO_VALUES}"
    return Figure(key, title, plot(draw, salt=f"figure-{key}"), Reproduction.RECOMPUTED, reason)


def figure_9(_: Simulation) -> Figure:
    """Return the report's item of a block diagram, which has no plot."""
    return Figure(
        "9",
        "Mittag-Leffler function as a Nussbaum function: block diagram",
        "",
        Reproduction.GIVEN,
        "A block diagram. Its function is kernels/observer/mittag_leffler.py, exact to 1e-10 of its envelope.",
    )


def figure_10(_: Simulation) -> Figure:
    """Draw N(k)."""
    k = np.linspace(0.0, 14.0, 1500)

    def draw(axes: Any) -> None:
        for alpha in (2.2, 2.5, 2.9):
            tables = decay_table(alpha)
            n = np.array([mittag_leffler(x, alpha, series_coefficients(alpha), *tables) for x in k])
            axes.plot(k, n, label=f"$E_{{{alpha}}}(-k^{{{alpha}}})$")
        axes.axhline(0.0, color=FAINT, linewidth=0.8)
        axes.set(xlabel="k", ylabel="N(k)", xlim=(0.0, 14.0))
        axes.set_yscale("symlog", linthresh=1.0)
        axes.legend(loc="best")

    return Figure(
        "10",
        "Mittag-Leffler function as a Nussbaum function: output",
        plot(draw, salt="figure-10"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} It is printed with a plus sign (E1), but E_a(+λk^a) has only positive terms and is not a Nussbaum function. "
        "With a minus sign it oscillates with growing amplitude, as a Nussbaum function must. λ = 1; logarithmic beyond ±1.",
    )


def figure_13(s: Simulation) -> Figure:
    """Draw the voltage of scheme 1 at run time."""
    run = s.fitted_start.scheme_1
    return Figure(
        "13",
        "Scheme 1: y(t) and ŷ(t) at run time",
        plot(tracking_plot(run, "ŷ, scheme 1"), salt="figure-13"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} The observer's output follows the cell's, as the thesis says. Sign of N as E1; start and λ of E25.",
    )


def figure_14(s: Simulation) -> Figure:
    """Draw the error of scheme 1."""
    run = s.fitted_start.scheme_1
    # without the last snapshots, in which the voltage collapses
    largest_mv = 1e3 * float(np.abs(run.error_v[run.time_s > 60.0][:-60]).max())
    return Figure(
        "14",
        "Scheme 1: error e(t) at run time",
        plot(lambda axes: error_plot(axes, run), salt="figure-14"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} After the first minute |e| stays below {largest_mv:.2f} mV until the voltage collapses. Both axes are "
        "logarithmic, the error's within ±0.1 mV linear. Start and λ of E25.",
    )


def figure_15(s: Simulation) -> Figure:
    """Draw the voltage of scheme 1 with frozen parameters."""
    frozen = s.frozen(s.fitted_start.scheme_1.average)
    return Figure(
        "15",
        "Scheme 1: the model with its averaged parameters",
        plot(lambda axes: frozen_plot(axes, frozen, "ŷ, parameters of Table 2"), salt="figure-15"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} The shape is right and the values are wrong, as the thesis says: the mean error is {frozen.mean_percent:.1f} %. "
        "Start and λ of E25.",
    )


def _frozen_and_error(key: str, title: str, frozen: Prediction, run: AdaptiveRun, reason: str) -> Figure:
    def draw(axes: Any) -> None:
        frozen_plot(axes[0], frozen, "ŷ, parameters frozen")
        axes[0].set_title("frozen parameters")
        error_plot(axes[1], run)
        axes[1].set_title("error at run time")

    return Figure(key, title, plot(draw, columns=2, salt=f"figure-{key}"), Reproduction.RECOMPUTED, reason)


def figure_16(s: Simulation) -> Figure:
    """Draw voltage and error of scheme 2."""
    run = s.fitted_start.scheme_2
    frozen = s.frozen(run.average)
    reason = (
        f"{NO_VALUES} The small parameters stay at their initial values, which are rounded true values. The mean error of the frozen "
        f"model of {frozen.mean_percent:.2f} % therefore comes from its initial values and not from learning. Sign of N as in E1; start "
        "and λ of E25."
    )
    return _frozen_and_error("16", "Scheme 2: frozen model and run-time error", frozen, run, reason)


def figure_17(s: Simulation) -> Figure:
    """Draw voltage and error of scheme 3."""
    frozen = s.frozen(s.scheme_3.average)
    reason = f"{NO_VALUES} The mean error of the frozen model is {frozen.mean_percent:.2f} %. Sign of N as in E1."
    return _frozen_and_error("17", "Scheme 3: frozen model and run-time error", frozen, s.scheme_3, reason)


def figure_19(s: Simulation) -> Figure:
    """Draw a8 and a11 over SOC with their stability conditions."""
    c8, c11 = s.improved.crossings
    return Figure(
        "19",
        "a8 and a11 meet their stability conditions",
        plot(lambda axes: crossing_plot(axes, s.improved), columns=2, salt="figure-19"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} a8 meets its condition at SOC {c8.soc:.5f}, a11 at {c11.soc:.5f}: delta1 and delta2 of the estimates. The "
        "observer stops adapting 0.005 above the larger one (E14). a7 and a8 with the weights of E24 and E4.",
    )


def figure_20(s: Simulation) -> Figure:
    """Draw the RC products."""
    printed_errors = [mean_error_percent(name, s.printed_a, s.cell.a) for name in PRODUCTS]
    return Figure(
        "20",
        "R_ts·C_ts and R_tl·C_tl: estimated and true",
        plot(lambda axes: products_plot(axes, s.cell.a, s.improved.average), columns=2, salt="figure-20"),
        Reproduction.CONTRADICTED,
        "The printed products coincide; the recomputed ones do not. The errors of the products from the printed estimates are "
        f"{printed_errors[0]:.1f} and {printed_errors[1]:.1f} %, and the recomputed products depend on the bounds (E3, E9, test of "
        "Theorem 4.1.2).",
    )


def figure_21(s: Simulation) -> Figure:
    """Draw the elements."""

    def draw(axes: Any) -> None:
        elements_plot(axes, s.cell.a, s.improved.average, [c.soc for c in s.improved.crossings])

    return Figure(
        "21",
        "R_tl, R_ts, C_tl, C_ts with the stability conditions",
        plot(draw, rows=2, columns=2, salt="f21"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} Estimated elements are those of the Lemma 4.1.3 limits (weights: E4, E24). Dashed and dotted: delta1 "
        "and delta2.",
    )


def figure_22(s: Simulation) -> Figure:
    """Draw R_s at several currents."""

    def draw(axes: Any) -> None:
        for current, r_s_curve in s.r_s_curves.items():
            axes.plot(r_s_curve.soc, r_s_curve.r_s_ohm, label=f"{current:g} A", linewidth=1.0)
        axes.plot(SOC_GRID, s.r_s_fit(SOC_GRID), "k--", label="fit of the mean")
        axes.plot(SOC_GRID, [r_s(x, s.cell.a) for x in SOC_GRID], color=FAINT, linewidth=2.4, label="Chen and Mora")
        axes.set(xlabel="SOC", ylabel="R_s [Ω]", ylim=(0.0, 0.15))
        axes.legend(loc="best", ncols=2)

    return Figure(
        "22",
        "R_s by (4.2) for different currents",
        plot(draw, salt="figure-22"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} (4.2) with the sign of (2.4) (E19). The thesis does not print the currents. The error of R_s is the negative "
        "of that of R_ts + R_tl.",
    )


def figure_23(s: Simulation) -> Figure:
    """Draw the final model."""
    runs = {
        "Tables 5 and 6": s.frozen(s.printed_a, FINAL_SOC),
        "steps 2 and 3 as run here": s.frozen(s.improved_a, FINAL_SOC),
    }
    as_printed, refitted = runs.values()

    def draw(axes: Any) -> None:
        frozen_plot(axes[0], as_printed, "estimated model, Tables 5 and 6")
        t, run = thin(s.improved.time_s / 600.0, s.improved.voltage_estimate_v)
        axes[0].plot(t, run, ":", color=COLORS[2], label="run time (C/10, time / 10)")
        axes[0].legend(loc="best")
        for label, prediction in runs.items():
            t, e = thin(prediction.time_s / 60.0, 1e3 * prediction.error_v)
            axes[1].plot(t, e, label=label)
        axes[1].set(xlabel="time [min]", ylabel="mV", title="true minus estimated")
        axes[1].legend(loc="best")

    return Figure(
        "23",
        "The estimated model against the cell, constant discharge",
        plot(draw, columns=2, salt="figure-23"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} With the printed Tables 5 and 6 the mean error of the model is {as_printed.mean_percent:.3f} %, at most "
        f"{as_printed.max_percent:.1f} %, down to SOC {FINAL_SOC:g}. With the recomputed a1 to a12 and refitted a13 to a15 it is "
        f"{refitted.mean_percent:.4f} %, at most {refitted.max_percent:.2f} %, although the elements are those of the bounds: under a "
        "slow load only the sum of the resistances matters, which (4.2) corrects.",
    )


def figure_39(s: Simulation) -> Figure:
    """Draw the errors of the dynamic and the static model in simulation."""
    dynamic, static = s.dynamic(s.printed_a), s.static(s.printed_a)
    return Figure(
        "39",
        "Dynamic and static model, simulation",
        plot(lambda axes: dynamic_static_plot(axes, dynamic, static), columns=2, salt="figure-39"),
        Reproduction.NO_DATA,
        f"Load and SOC of the static model are not printed; here pulses of 0.275 A, SOC {STATIC_SOC:g}, and parameters of Tables 5 "
        "and 6. As in print, the two models differ at low SOC.",
    )


def figure_43(s: Simulation) -> Figure:
    """Draw the open-circuit voltage E_o of a healthy and of a faulty bank of three batteries, with the located dips."""
    bank = BankExperiment(s.cell)
    dips = bank.dips

    def draw(axes: Any) -> None:
        for label, discharge in (("healthy bank", bank.healthy), ("two weak batteries", bank.faulty)):
            axes.plot(discharge.drawn, discharge.e_o_v, label=label)
        for drawn in dips:
            axes.axvline(drawn, color=FAINT, linestyle="--", label="located dip" if drawn == dips[0] else None)
        axes.axvline(bank.drawn_at_warning, color=COLORS[2], linestyle=":", label="warning")
        axes.set(xlabel="charge drawn, in capacities of one battery", ylabel="E_o of the bank [V]")
        axes.legend(loc="best")

    located = " and ".join(f"{drawn:.2f}" for drawn in dips)
    return Figure(
        "43",
        "E_o of a healthy bank and of one with two weak batteries",
        plot(draw, salt="figure-43"),
        Reproduction.NO_DATA,
        f"The bank's batteries and their SOC are not printed; here three cells of Chen and Mora in series under a load of {LOAD_C:g} C, "
        f"two of which start at SOC {WEAK_SOC[0]:g} and {WEAK_SOC[1]:g}. E_o is the measured voltage, corrected for the load. As in print, "
        f"each weak battery causes a dip when it is empty. The dips are located at {located} of the charge, where E_o falls fastest below "
        f"that of the healthy bank. The comparison with two healthy discharges warns at {bank.drawn_at_warning:.2f}. The sum does not show which "
        "battery is weak.",
    )


FIGURES: dict[str, Callable[[Simulation], Figure]] = {key: partial(curve, key) for key in CURVES} | {
    "9": figure_9,
    "10": figure_10,
    "13": figure_13,
    "14": figure_14,
    "15": figure_15,
    "16": figure_16,
    "17": figure_17,
    "19": figure_19,
    "20": figure_20,
    "21": figure_21,
    "22": figure_22,
    "23": figure_23,
    "39": figure_39,
    "43": figure_43,
}
