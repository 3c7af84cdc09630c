"""Errata E1 to E37 of the thesis, numbered as in docs/theory/thesis.md.

Corrected numbers are computed. Printed numbers come from ``printed_values``.
"""

from dataclasses import dataclass

from bms_estimator.estimator.stability_conditions import Condition, lemma_conditions
from bms_estimator.kernels.cell_model.chen_mora import delta, emf
from bms_estimator.model.cell import CellModel, generic_cells, load_cell
from bms_estimator.reports.report_parts import number
from bms_estimator.reports.thesis import printed_pack, printed_values
from bms_estimator.reports.thesis.report_items import Reproduction, Table
from bms_estimator.reports.thesis.simulated_experiment import pack
from bms_estimator.reports.thesis.simulation import ALPHA, CURRENT_A, Simulation, mean_error_percent
from bms_estimator.reports.thesis.theorem_4_1_2 import C_RATES, PRODUCTS, measure, quasi_steady

SMALLEST_CURRENT_A = 1e-4
"""Current that stands for the theorem's infinitesimal current [A]."""
OCV_ERROR_V = 0.010
"""Error of E_o assumed by erratum 19 [V]."""
SLOW_C = 1.0 / 20.0
"""C-rate of erratum 19 [1/h]."""
RESISTORS = ("50 ohm", "25 ohm", "12.5 ohm")
"""Resistors in order of decreasing resistance."""
CELLS = ("chen_mora", "ncr18650", "thunder_power_6s")
"""Cells of 275 mAh, 3 Ah and 6.6 Ah."""


@dataclass(frozen=True)
class Erratum:
    """Erratum of the thesis.

    Attributes:
        location: Equation, table or section.
        printed: Printed text.
        corrected: Correction, or comment.
    """

    location: str
    printed: str
    corrected: str


def errata(s: Simulation) -> list[Erratum]:
    """Return E1 to E37 in order."""
    return [*_first(s), *_theory(s), *_experiments(s), *_second_audit(s), *_later_chapters()]


def table(s: Simulation) -> Table:
    """Return the errata as a table of the report."""
    rows = tuple((f"E{n}", e.location, e.printed, e.corrected) for n, e in enumerate(errata(s), 1))
    return Table(
        "Errata",
        "printed and corrected",
        ("number", "location", "printed", "corrected"),
        rows,
        Reproduction.ADDED,
        "The project uses the corrected forms. The numbers are computed with this report.",
    )


def _first(s: Simulation) -> list[Erratum]:
    """Return E1 to E14."""
    true, estimated = s.cell.a, s.printed_a
    a8, inferred_a8 = printed_values.BOUNDS[8], _weights(printed_values.A8_WEIGHTS)
    failing_condition = next(c for c in lemma_conditions(load_cell("chen_mora")) if not c.holds)
    errors_percent = {i: 100.0 * abs(row[1] / row[2] - 1.0) for i, row in printed_values.TABLE_5.items()}
    r_s_errors = [f"{100.0 * abs(row[1] / row[0] - 1.0):.1f}" for row in printed_values.TABLE_6.values()]
    products = [f"{mean_error_percent(name, estimated, true):.1f}" for name in PRODUCTS]
    at_1c_v, at_smallest_v = (
        [m.tracking_v for m in measure() if m.c_rate == rate] for rate in (max(C_RATES), min(C_RATES))
    )
    deltas = [
        f"{float(delta(p[8], p[9], p[7])):.6f}, {float(delta(p[11], p[12], p[10])):.6f}" for p in (true, estimated)
    ]
    return [
        Erratum("(3.10)", "plus sign", "minus sign; otherwise it is not a Nussbaum function"),
        Erratum("(3.13)", "k' = e²", "with a real converter k grows without bound; a dead zone is needed"),
        Erratum(
            "Theorem 4.1.2",
            "parameters are identified, e goes to zero",
            "parameters converge to a weighted mean of their bounds, for any data; the output is tracked: |e| at most "
            f"{1e3 * min(at_1c_v):.2f} to {1e3 * max(at_1c_v):.2f} mV at {CURRENT_A:g} A, {1e6 * min(at_smallest_v):.0f} to {1e6 * max(at_smallest_v):.0f} "
            f"µV at {1e3 * min(C_RATES) * CURRENT_A:.2f} mA",
        ),
        Erratum(
            "Tables 5, 10, a8",
            f"weights {_weights(a8[2:])}",
            f"{inferred_a8}: the limit of the printed ones is {(a8[2] * a8[0] + a8[3] * a8[1]) / (a8[2] + a8[3]):.2f}, printed "
            f"are {printed_values.TABLE_5[8][1]:.2f} and {printed_values.TABLE_10[8][1]:.2f}, that of {inferred_a8} is "
            f"{printed_values.bounds('5', 8).limit:.2f}",
        ),
        Erratum("Table 10, a5", f"{printed_values.TABLE_10[5][1]:g}", f"{printed_values.bounds('10', 5).limit:g}"),
        Erratum(
            "Table 5",
            "conditions of Lemma 4.1.1 followed",
            f"the first fails: {number(failing_condition.left, 6)} against {number(failing_condition.right, 6)}",
        ),
        Erratum(
            "Table 5, errors",
            "of the estimate",
            "of the true value: " + ", ".join(f"a{i} {errors_percent[i]:.1f}" for i in (1, 3, 4, 6, 8, 12)) + " %",
        ),
        Erratum("Table 6, errors", "fractions and a value", f"{r_s_errors[0]}, {r_s_errors[1]}, {r_s_errors[2]} %"),
        Erratum(
            "Table 7",
            f"products right to {printed_values.TABLE_7[PRODUCTS[0]]:.2f} and {printed_values.TABLE_7[PRODUCTS[1]]:.3f} %",
            f"{products[0]} and {products[1]} %, from Table 5's own values",
        ),
        Erratum("Algorithm 1", "a1, a2, a3 at t0; e < eps2", "x1, x2, x3; abs(e) < eps2"),
        Erratum("(3.1), (3.18)", "no dot", "time derivatives"),
        Erratum("4.1.1", "0.275 mA battery", f"{1e3 * s.cell.cell.capacity_ah:g} mAh"),
        Erratum(
            "(2.11), (2.12)",
            "-",
            f"delta1, delta2 are {deltas[0]} of Chen and Mora's values, {deltas[1]} of Table 5's estimates",
        ),
        Erratum("near empty", "-", "C_ts, C_tl are negative below delta1, delta2; adaptation must stop before"),
    ]


def _theory(s: Simulation) -> list[Erratum]:
    """Return E15 to E19."""
    at_1c, at_smallest = (quasi_steady(s.cell, i) for i in (CURRENT_A, SMALLEST_CURRENT_A))
    initial_conditions = [c for c in lemma_conditions(load_cell("thunder_power_6s")) if "(0)" in c.name]
    rate_condition = next(c for c in lemma_conditions(pack()) if "rate of a7" in c.name)
    r_s_errors = {load_cell(name).cell.capacity_ah: ocv_error_ohm(load_cell(name)) for name in CELLS}
    true_r_s_ohm, fitted_r_s_ohm = float(s.cell.a[15]), float(s.r_s_fit.a[2])
    excess_ohm = sum(float(s.improved.average[i] - s.cell.a[i]) for i in (3, 6))
    return [
        Erratum(
            "(3.2), (3.3)",
            "the same u drives both branches",
            "those of the cell are driven by i/C_ts and i/C_tl. Therefore x2 : x3 is tau_ts : tau_tl instead of R_ts : R_tl, "
            f"which is equal only if C_ts = C_tl. With all parameters true, x3 is {1e3 * at_1c.observer_v[1]:.1f} mV instead of "
            f"the cell's {1e3 * at_1c.cell_v[1]:.1f}, and x2 is {1e3 * at_1c.observer_v[0]:.1f} mV instead of "
            f"{1e3 * at_1c.cell_v[0]:.1f} (after half an hour at {CURRENT_A:g} A)",
        ),
        Erratum(
            "(4.64)-(4.66)",
            "e goes to zero, the products follow",
            f"quasi-steadily u = x2/tau_ts, so e = -x2/(N tau_ts) = {1e3 * at_1c.predicted_v:.3f} mV at {CURRENT_A:g} A, measured "
            f"{1e3 * at_1c.error_v:.3f}; at {1e3 * SMALLEST_CURRENT_A:g} mA {1e6 * at_smallest.error_v:.3f} µV. Every term of (4.66) is "
            "proportional to i, so that in the limit it reads 0 = 0",
        ),
        Erratum(
            "Theorem 4.1.2",
            "t to infinity; then i = y = x1 = 0",
            f"x1 falls below delta1 and delta2, where the Lemma does not hold, and y = E_o(0) = {emf(0.0, s.cell.a):.3f} V by (2.10)",
        ),
        Erratum(
            "Lemma 4.1.1",
            "conditions for C_ts, C_tl > 0",
            "circular: the condition on a8 (a11) is C_ts > 0 (C_tl > 0) rewritten, and the others only ensure that delta1 and "
            f"delta2 are positive. Table 10's initial values violate the first two ({_sides(initial_conditions[0])}; {_sides(initial_conditions[1])}). "
            f"With the weights of E24 the rate of a7 is too high as well ({number(rate_condition.left)} > {number(rate_condition.right)})",
        ),
        Erratum(
            "(4.2)",
            "sign; divided by i",
            f"(2.4) has the opposite sign. R_s absorbs the error of R_ts + R_tl: it is {1e3 * fitted_r_s_ohm:.1f} mΩ, and {1e3 * true_r_s_ohm:.1f} minus "
            f"the error {1e3 * excess_ohm:.1f} is {1e3 * (true_r_s_ohm - excess_ohm):.1f}. An error of E_o of {1e3 * OCV_ERROR_V:g} mV gives "
            + ", ".join(f"{1e3 * ohm:.0f} mΩ at C/20 of {ah:g} Ah" for ah, ohm in r_s_errors.items())
            + ". Step 2 requires i to 0, but step 3 a large i: weight by the current",
        ),
    ]


def _experiments(s: Simulation) -> list[Erratum]:
    """Return E20 to E26."""
    currents = printed_pack.current_errors_percent()
    ohm = " / ".join(f"{printed_values.RESISTORS_OHM[load]:g}" for load in RESISTORS)
    deviations = " / ".join(f"{currents[load]:.1f}" for load in RESISTORS)
    pack_of_thesis, cell_of_chen_mora = load_cell("thunder_power_6s").cell, s.cell.cell
    cells_in_parallel = pack_of_thesis.capacity_ah / cell_of_chen_mora.capacity_ah
    inferred_weights = printed_values.INFERRED_WEIGHTS["10"]
    return [
        Erratum(
            "5.1",
            f"0-{printed_values.SENSOR_RANGE_V:g} V sensor",
            f"cannot measure {emf(1.0, printed_pack.A):.2f} V: saturated above SOC {printed_pack.saturated_above_soc():.3f} (Table 8)",
        ),
        Erratum(
            "5.2.1",
            "currents of the loads",
            f"contradict Ohm's law with Tables 8 to 10 by {deviations} % at {ohm} Ω",
        ),
        Erratum(
            "Figure 29, Table 10",
            "compared with Chen and Mora",
            f"a pack of {pack_of_thesis.series_count} cells in series and {pack_of_thesis.capacity_ah:g} Ah is compared with a cell of "
            f"{1e3 * cell_of_chen_mora.capacity_ah:g} mAh, and has its bounds. If it consisted of such cells, it would have "
            f"{pack_of_thesis.series_count / cells_in_parallel:.2f} times the resistances and {cells_in_parallel / pack_of_thesis.series_count:.0f} times the "
            "capacitances; only the products would be equal",
        ),
        Erratum(
            "(4.60), (4.63), (4.71)-(4.72)",
            "dE/dx1; no 1; C^ + Delta",
            "dE/dx1 x1'; the 1 of (4.58) stays; C + Delta, since C^ = C + Delta",
        ),
        Erratum(
            "Tables 5, 10, weights",
            f"a7 {_weights(printed_values.BOUNDS[7][2:])}; Table 10 a4 {_weights(printed_values.BOUNDS[4][2:])}",
            f"a7 in the ratio of {_weights(inferred_weights[7])} in both, which in Table 10 gives {printed_values.mean_from_start('10', 7):.2f} "
            f"({printed_values.TABLE_10[7][1]:.2f}) and in Table 5, as {_weights(printed_values.INFERRED_WEIGHTS['5'][7])}, "
            f"{printed_values.mean_from_start('5', 7):.4f} ({printed_values.TABLE_5[7][1]:.4f}); a4 {_weights(inferred_weights[4])}: "
            f"{printed_values.mean_from_start('10', 4):.4f} ({printed_values.TABLE_10[4][1]:.4f}); inferred, as E4",
        ),
        Erratum(
            "Tables 2, 3",
            "starts at the desired values, errors of 0 %",
            f"a family of starts fits both tables: e(0) = {_starts(s)}; the start is the "
            "rounded true value ("
            + ", ".join(
                f"a{i} {100.0 * (printed_values.CHEN_MORA_ROUNDED[i - 1] / s.cell.a[i] - 1.0):.0f} %" for i in (13, 6)
            )
            + "), so that 0 % is an artefact",
        ),
        Erratum(
            "cross references",
            "3.2.5.2 Figure 15; 4.1.1 Table 7; chapter 6 Tables 6 and 7; 5.2.2 Lemma 4.1.1",
            "Figure 16; Table 5; Tables 5 and 6; Lemma 4.1.3",
        ),
    ]


def _second_audit(s: Simulation) -> list[Erratum]:
    """Return E27 to E33."""
    at_1c = quasi_steady(s.cell, CURRENT_A)
    mean_percent, largest_percent, usual_percent = (
        printed_values.TABLE_11["constant steps"],
        printed_values.MAX_CONSTANT_STEPS,
        printed_values.USUAL_STEPS,
    )
    capacity_ah, bulb_a = load_cell("thunder_power_6s").cell.capacity_ah, printed_values.CURRENTS_A["50 W bulb"]
    bulb_v = printed_pack.mean_voltage_v(bulb_a)
    offset_a, gain = printed_pack.current_sensor()
    differences_a = printed_pack.current_differences_a()
    differences_ma = ", ".join(f"{1e3 * differences_a[load]:.0f}" for load in RESISTORS)
    rates = {i: printed_values.implied_rates(i) for i in printed_values.INFERRED_WEIGHTS["5"]}
    excess = {i: printed_values.TABLE_10[i][1] - printed_values.bounds("10", i).limit for i in (10, 12)}
    return [
        Erratum(
            "(3.14)",
            "u R_s in the output",
            f"i R_s, as in (2.4): u R_s is in V Ω/s, and after half an hour at {CURRENT_A:g} A it is {1e3 * at_1c.driven_v:.3f} mV "
            f"instead of the ohmic drop of {1e3 * at_1c.ohmic_v:.1f} mV. The drop is added to x2 + x3, which is "
            f"{1e3 * sum(at_1c.observer_v):.1f} mV instead of {1e3 * sum(at_1c.cell_v):.1f}, so that a13 to a15 have nearly no "
            "effect in schemes 1 to 3",
        ),
        Erratum(
            "5.3.2, Table 11",
            f"error mostly close to {usual_percent:g} %, largest {largest_percent:g} % under constant steps",
            f"with these the printed mean of {mean_percent:g} % needs the largest error during at least "
            f"{100.0 * (mean_percent - usual_percent) / (largest_percent - usual_percent):.0f} % of the time",
        ),
        Erratum(
            "5.2",
            f"runs of {printed_values.RUN_HOURS[0]:g} to {printed_values.RUN_HOURS[1]:g} hours",
            f"the bulb's {bulb_a:g} A empties {capacity_ah:g} Ah in {capacity_ah / bulb_a:.1f} h; the relaxation test at 50 Ω, "
            f"loaded half of the time, takes {2.0 * capacity_ah / printed_values.CURRENTS_A['50 ohm']:.1f} h",
        ),
        Erratum(
            "5.2.1",
            f"{printed_values.BULB_W:g} W DC bulb",
            f"{bulb_a:g} A at the pack's mean of {bulb_v:.1f} V are {bulb_a * bulb_v:.0f} W and {bulb_v / bulb_a:.2f} Ω, as of the two "
            "12 V bulbs of 5.1 in series",
        ),
        Erratum(
            "5.2.1",
            "currents of the loads (E21)",
            f"their differences from Ohm's law, {differences_ma} mA at "
            + ", ".join(f"{printed_values.RESISTORS_OHM[load]:g}" for load in RESISTORS)
            + f" Ω, are an offset of {1e3 * offset_a:.0f} mA and {100.0 * gain:.1f} % of the current. These are plausible errors of the "
            "sensor, which would make the counted charge too small as well",
        ),
        Erratum(
            "Table 5, weights",
            "rates of a7, a8, a10, a11, a12: "
            + ", ".join(f"{sum(printed_values.BOUNDS[i][2:]):g}" for i in rates)
            + " /s",
            "the printed digits imply "
            + ", ".join(f"{low:.0f} to {high:.0f}" for low, high in rates.values())
            + " /s; "
            + "; ".join(_weights(pair) for pair in printed_values.INFERRED_WEIGHTS["5"].values())
            + f" give every digit. The weights {_weights(printed_values.A8_WEIGHTS)} of E4 only have the right ratio",
        ),
        Erratum(
            "5.2.2",
            "does not depend on initial conditions",
            "the printed "
            + " and ".join(
                f"a{i} lies {excess_of_index:.1f} above its limit after a start at {printed_values.initial('10', i):.1e}"
                for i, excess_of_index in excess.items()
            ),
        ),
    ]


def _later_chapters() -> list[Erratum]:
    """Return E34 to E37."""
    return [
        Erratum(
            "Theorem 4.1.2, proof",
            "(4.32), (4.33); k bounded, so k' goes to 0; (4.70)",
            "(4.32), (4.33) need x2^, x3^ > 0; a bounded k gives k' to 0 only where e² is uniformly continuous (Barbalat's lemma), "
            "which is not shown; (4.70) drops the transform of e² in (4.69)",
        ),
        Erratum(
            "7.1",
            "interpolation in E_o(SOC) gives a more accurate SOC than the count",
            "E_o(SOC) depends on the counted SOC that it is supposed to correct, and so do x2, x3 and R_s of the model",
        ),
        Erratum(
            "Chapter 3, step 2; Algorithm 1",
            "data from step 3; Continue after Return",
            "step 1; Continue cannot be reached: the loop must run until t_max and return once",
        ),
        Erratum(
            "2.1.2",
            "the battery must be switched off at delta2",
            "delta1 and delta2 say where (2.7), (2.8) with the fitted a7 to a12 are not valid, not where a battery is empty: for the "
            f"generic cells of this project they are at most {_highest_generic_delta():.4f}, so that they would allow a discharge beyond "
            "SOC 0. The cut-off voltage ends a discharge",
        ),
    ]


def _highest_generic_delta() -> float:
    """Return the largest delta1 or delta2 of the generic cells, with the limits of a7..a12 by Lemma 4.1.3."""
    deltas = []
    for name in generic_cells():
        cell = load_cell(name, capacity_ah=1.0)
        deltas += [delta(*(cell.bounds(i).limit for i in indices)) for indices in ((8, 9, 7), (11, 12, 10))]
    return max(deltas)


def _starts(s: Simulation) -> str:
    """Describe the fitted starts by error and lambda."""
    return ", ".join(
        f"{start.start_error_v:.3f} V with λ = {start.lambda_:.2f}"
        + ("" if start.alpha == ALPHA else f" at a = {start.alpha:g}")
        for start in (s.fitted_start, *s.other_starts)
    )


def _weights(pair: tuple[float, ...]) -> str:
    return ", ".join(f"{weight:g}" for weight in pair)


def _sides(condition: Condition) -> str:
    return f"{condition.left:.2e} > {condition.right:.2e}"


def ocv_error_ohm(cell: CellModel) -> float:
    """Return the error of R_s by (4.2) at C/20 for an E_o error of ``OCV_ERROR_V`` [ohm]."""
    return OCV_ERROR_V / (SLOW_C * cell.cell.capacity_ah)
