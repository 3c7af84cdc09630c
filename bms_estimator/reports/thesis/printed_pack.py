"""Pack with the parameters of Tables 8 to 10 of the thesis: Figures 28 to 30, and a check of the printed currents.

Numbers in parentheses are equations of the thesis, and E1 to E37 are its errata (``errata``).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import delta, emf, r_s
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.reports.report_parts import plot
from bms_estimator.reports.thesis import printed_values
from bms_estimator.reports.thesis.observer_plots import NO_VALUES, condition_plot, elements_plot, products_plot
from bms_estimator.reports.thesis.report_items import Figure, Reproduction
from bms_estimator.reports.thesis.simulation import element, mean_error_percent
from bms_estimator.reports.thesis.theorem_4_1_2 import PRODUCTS

A = printed_values.tables_8_to_10()
"""Parameters a1..a21 of Tables 8 to 10 at index 1..21."""
EMPTY_SOC = 0.02
"""SOC at the end of a discharge through a resistor, above delta2, the SOC below which C_tl is negative."""
GRID = np.linspace(EMPTY_SOC, 1.0, 9801)
"""SOC over which means are computed."""


def deltas() -> tuple[float, float]:
    """Return delta1 (2.11) and delta2 (2.12) of Table 10, the SOCs below which C_ts and C_tl are negative."""
    return float(delta(A[8], A[9], A[7])), float(delta(A[11], A[12], A[10]))


def product_errors() -> tuple[float, float]:
    """Return the mean errors of R_ts C_ts and R_tl C_tl relative to the cell of Chen and Mora, as in Fig. 29 [%]."""
    true = load_cell("chen_mora").a
    return mean_error_percent(PRODUCTS[0], A, true), mean_error_percent(PRODUCTS[1], A, true)


def mean_current_a(ohm: float) -> float:
    """Return the mean current of a slow discharge through ``ohm`` by Ohm's law with Tables 8 to 10 [A].

    The mean over time is the charge divided by the duration, which is the integral of dq / i.
    """
    current_a = np.array([emf(x, A) for x in GRID]) / (ohm + _inner_ohm())
    return float(1.0 / np.mean(1.0 / current_a))


def _inner_ohm() -> Floats:
    """Return the total resistance R_s + R_ts + R_tl of Tables 8 to 10 over ``GRID`` [ohm]."""
    ohm: Floats = element("R_ts", A, GRID) + element("R_tl", A, GRID) + np.array([r_s(x, A) for x in GRID])
    return ohm


def mean_voltage_v(current_a: float) -> float:
    """Return the mean terminal voltage of a slow discharge at ``current_a`` by Tables 8 to 10 [V]."""
    return float(np.mean(np.array([emf(x, A) for x in GRID]) - current_a * _inner_ohm()))


def current_differences_a() -> dict[str, float]:
    """Return each printed current minus the current by Ohm's law [A]."""
    return {
        load: printed_values.CURRENTS_A[load] - mean_current_a(ohm)
        for load, ohm in printed_values.RESISTORS_OHM.items()
    }


def current_sensor() -> tuple[float, float]:
    """Return offset [A] and gain error of a current sensor that explain the differences, by least squares."""
    true_a = np.array([mean_current_a(ohm) for ohm in printed_values.RESISTORS_OHM.values()])
    gain, offset_a = np.polyfit(true_a, list(current_differences_a().values()), 1)
    return float(offset_a), float(gain)


def current_errors_percent() -> dict[str, float]:
    """Return the deviation of each printed current from Ohm's law [%]."""
    return {
        load: 100.0 * (printed_values.CURRENTS_A[load] / mean_current_a(ohm) - 1.0)
        for load, ohm in printed_values.RESISTORS_OHM.items()
    }


def saturated_above_soc() -> float:
    """Return the SOC at which E_o of Table 8 reaches the end of the voltage sensor's range."""
    e_o = np.array([emf(x, A) for x in GRID])
    return float(np.interp(printed_values.SENSOR_RANGE_V, e_o, GRID))


def figure_28() -> Figure:
    """Draw a8 and a11 of Table 10 with their stability conditions over SOC."""
    crossing_socs = deltas()

    def draw(axes: Any) -> None:
        for ax, i, crossing_soc in zip(axes, (8, 11), crossing_socs, strict=True):
            ax.plot((0.4 * crossing_soc, 12.0 * crossing_soc), (A[i], A[i]), label=f"$a_{{{i}}}$ of Table 10")
            condition_plot(ax, i, float(A[i]), crossing_soc)

    return Figure(
        "28",
        "a8 and a11 meet their stability conditions",
        plot(draw, columns=2, salt="figure-28"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} From Table 10 alone: delta1 = {crossing_socs[0]:.6f}, delta2 = {crossing_socs[1]:.6f}.",
    )


def figure_29() -> Figure:
    """Draw the RC products."""
    true, errors = load_cell("chen_mora").a, product_errors()
    return Figure(
        "29",
        "R_ts·C_ts and R_tl·C_tl as estimated",
        plot(lambda axes: products_plot(axes, true, A), columns=2, salt="figure-29"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} From Table 10 alone, compared with Chen and Mora as in print: the mean errors over SOC 0.05 to 1 are "
        f"{errors[0]:.1f} and {errors[1]:.1f} % (a5 = 150, E5). They are the products of the bounds' limits (E3), and the reference "
        "is another battery (E22).",
    )


def figure_30() -> Figure:
    """Draw the elements."""
    return Figure(
        "30",
        "R_tl, R_ts, C_tl, C_ts with the stability conditions",
        plot(lambda axes: elements_plot(axes, None, A, deltas()), rows=2, columns=2, salt="figure-30"),
        Reproduction.RECOMPUTED,
        f"{NO_VALUES} From Table 10 alone (a5 = 150, E5). Dashed and dotted: delta1 and delta2.",
    )


FIGURES: dict[str, Callable[[], Figure]] = {"28": figure_28, "29": figure_29, "30": figure_30}
