"""Tables 8 to 11 and 13 of the thesis: results of the procedure of chapter 5, with the printed values.

Numbers in parentheses are equations of the thesis, and E1 to E37 are its errata (``errata``).
"""

from collections.abc import Callable

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import REST_C_RATE
from bms_estimator.calibration.ocv.chen_mora_fit import average, chen_mora, max_v, pool_tests, rms_v
from bms_estimator.reports.report_parts import number
from bms_estimator.reports.thesis import printed_values
from bms_estimator.reports.thesis.experiment import Experiment
from bms_estimator.reports.thesis.procedure import KNEE_SOC, STATIC_SOC
from bms_estimator.reports.thesis.report_items import Reproduction, Table


def table_8(experiment: Experiment) -> Table:
    """Return the table of a16 to a21."""
    procedure, truth = experiment.procedure, experiment.truth
    points = pool_tests(procedure.tests)
    mean, joint = average(procedure.single_fits), procedure.joint_fit
    columns = ["parameter", "printed"]
    columns += [] if truth is None else ["true"]
    columns += [test.name for test in procedure.tests] if len(procedure.tests) > 1 else []
    columns += ["mean (5.1)-(5.2)", "joint fit", "± std"]
    rows = []
    for j in range(6):
        row = [f"a{16 + j}", number(printed_values.TABLE_8[j], 5)]
        row += [] if truth is None else [number(float(truth[16 + j]), 5)]
        row += [number(float(fit.a[j]), 5) for fit in procedure.single_fits] if len(procedure.tests) > 1 else []
        row += [number(float(mean[j]), 5), number(float(joint.a[j]), 5), number(float(joint.std[j]), 2)]
        rows.append(tuple(row))
    residual_of_mean_v = points.ocv_v - chen_mora(mean, points.soc)
    table = procedure.table
    coarse = ""
    if experiment.coarse_procedure is not None:
        coarse = f" With 10 bits the residual of the joint fit is {1e3 * rms_v(experiment.coarse_procedure.joint_fit.residual_v):.2f} mV RMS."
    return Table(
        "8",
        "Step 1: a16 to a21 from voltage relaxation tests",
        tuple(columns),
        tuple(rows),
        Reproduction.NO_DATA,
        f"{experiment.data_note} {points.soc.size} points; residual RMS (largest): joint fit "
        f"{1e3 * rms_v(joint.residual_v):.2f} ({1e3 * max_v(joint.residual_v):.2f}) mV, mean of the parameters "
        f"{1e3 * rms_v(residual_of_mean_v):.2f} ({1e3 * max_v(residual_of_mean_v):.2f}) mV, monotone table {1e3 * rms_v(table.residual_v):.2f} "
        f"({1e3 * max_v(table.residual_v):.2f}) mV.{coarse}",
    )


def table_9(experiment: Experiment) -> Table:
    """Return the table of a13 to a15."""
    procedure, truth = experiment.procedure, experiment.truth
    fit = procedure.r_s_fit
    columns = ("parameter", "printed", *(() if truth is None else ("true",)), "recomputed", "± std")
    rows = []
    for j in range(3):
        row = [f"a{13 + j}", number(printed_values.TABLE_9[j])]
        row += [] if truth is None else [number(float(truth[13 + j]))]
        is_undefined = j == 1 and fit.a[0] == 0.0  # the exponent a14 of an amplitude a13 of 0
        rows.append((*row, "-" if is_undefined else number(float(fit.a[j])), number(float(fit.std[j]), 2)))
    return Table(
        "9",
        "Step 3: a13 to a15",
        columns,
        tuple(rows),
        Reproduction.NO_DATA,
        f"{experiment.data_note} R_s by (4.2), with the sign of (2.4) and each value weighted by its current squared (E19), "
        f"over {len(procedure.r_s_curves)} constant loads and relaxation tests; residual of the fit {1e3 * fit.rms_ohm:.2f} mΩ RMS. "
        "R_s absorbs the error of R_ts + R_tl, which come from the bounds. If a13 is 0, R_s does not rise towards empty.",
    )


def table_10(experiment: Experiment) -> Table:
    """Return the table of a1 to a12."""
    procedure, truth, run = experiment.procedure, experiment.truth, experiment.procedure.adaptive
    has_printed_bounds = experiment.recorded is None
    excess = {
        i: (printed_values.TABLE_10[i][1] - printed_values.bounds("10", i).limit, _excess_over_limit(i))
        for i in (8, 10, 12)
    }
    columns: tuple[str, ...] = ("parameter", "bounds", "λx, λy", "initial")
    columns += ("printed", "recomputed", "limit of Lemma 4.1.3")
    columns += ("mean from t0 over 10 h",) if has_printed_bounds else ()
    columns += () if truth is None else ("true",)
    rows = []
    for i, (_, estimate) in printed_values.TABLE_10.items():
        bounds = procedure.cell.bounds(i)
        row: tuple[str, ...] = (
            f"a{i}",
            f"{number(bounds.lower)} … {number(bounds.upper)}",
            f"{bounds.weight_upper:.4g}, {bounds.weight_lower:.4g}",
            number(bounds.limit if bounds.initial is None else bounds.initial),
            number(estimate, 6),
            number(float(run.average[i]), 6),
            number(bounds.limit, 6),
        )
        if has_printed_bounds:
            row += (number(printed_values.mean_from_start("10", i), 6),)
        rows.append(row if truth is None else (*row, number(float(truth[i]))))
    window = run.window
    bounds_reason = (
        "Weights of a8 as in E4, of a4 and a7 as in E24, inferred from the printed estimates. The printed a5 = 30 contradicts its "
        "bounds and weights, which give 150 (E5). The run gives the limits, which differ from the printed estimates. The other "
        f"eleven printed estimates are within {printed_values.worst_mean_percent():.1f} % of the mean over the first 10 h that follows "
        "from bounds, weights and initial values alone, without any data. This fit has "
        f"{printed_values.FREE_PARAMETERS['10']} free parameters: the time, and two weights each of a4, a7 and a8. It is a loose fit: "
        "the excess of the estimates over their limits is "
        + ", ".join(
            f"a{i} {number(mean_excess, 3)} (printed {number(printed_excess, 3)})"
            for i, (printed_excess, mean_excess) in excess.items()
        )
        + ". "
        if has_printed_bounds
        else "Bounds are the printed ones, scaled to the cell's capacity, unless the cell file has its own. "
    )
    return Table(
        "10",
        "Step 2: a1 to a12 by Algorithm 1",
        columns,
        tuple(rows),
        Reproduction.FITTED if has_printed_bounds else Reproduction.NO_DATA,
        f"{bounds_reason}Run on {procedure.smallest.name}: {run.outcome}; t_int = {window.t_int_s:.1f} s ({window.start_reason}), "
        f"t_unst = {window.t_unst_s:.0f} s ({window.end_reason}). The estimates are the limits of the bounds, on any data (E3).",
        free=printed_values.FREE_PARAMETERS["10"] if has_printed_bounds else 0,
    )


def _excess_over_limit(index: int) -> float:
    """Return the excess of a parameter of Table 10 over its limit if it is averaged from the first sample on."""
    return printed_values.mean_from_start("10", index) - printed_values.bounds("10", index).limit


def table_11(experiment: Experiment) -> Table:
    """Return the table of the validation."""
    procedure, coarse = experiment.procedure, experiment.coarse_procedure
    columns = ["load", "mean current [A]", "serves", "printed mean %", "mean %", "max %", "RMS [mV]"]
    columns += ["at SOC", f"mean %, SOC > {KNEE_SOC:g}", f"max %, SOC > {KNEE_SOC:g}"]
    columns += ["mean %, 10 bit", "max %, 10 bit"] if coarse else []
    rows = []
    validating = [capture.name for capture in procedure.validating]
    for name, run in procedure.dynamic.items():
        flowing = np.abs(run.current_a) > REST_C_RATE * procedure.cell.cell.capacity_ah
        aligned, above = run.aligned, run.above(KNEE_SOC)
        row = [
            name,
            number(float(run.current_a[flowing].mean()), 3),
            "validation" if name in validating else "step 2",
            number(printed_values.TABLE_11[name]) if name in printed_values.TABLE_11 else "-",
            number(run.mean_percent, 3),
            number(run.max_percent, 3),
            number(1e3 * rms_v(run.error_v), 3),
            number(float(run.soc[aligned][np.argmax(run.error_percent[aligned])]), 2),
            number(above.mean_percent, 3),
            number(above.max_percent, 3),
        ]
        if coarse:
            coarse_run = coarse.dynamic[name]
            row += [number(coarse_run.mean_percent, 3), number(coarse_run.max_percent, 3)]
        rows.append(tuple(row))
    verdict, claim_results = experiment.verdict_on_claims("constant loads, mean", "steps, mean")
    return Table(
        "11",
        "Validation: error of the output voltage with frozen parameters",
        tuple(columns),
        tuple(rows),
        verdict,
        f"{experiment.data_note} {claim_results}a1 to a12 from {procedure.smallest.name}, a16 to a21 from the relaxation tests, a13 "
        f"to a15 from all constant loads and relaxation tests except that of the row. Errors are in percent of the measured voltage, "
        f"from the first sample until SOC {procedure.lowest_soc:.2g}, counted from full. "
        + (
            "The simulated pack has exactly the form of the model, so that the errors are smaller than those of a real pack."
            if experiment.recorded is None
            else "Captures of several cells count as one cell here."
        ),
    )


def table_13(experiment: Experiment) -> Table:
    """Return the comparison of the dynamic and the static model."""
    procedure = experiment.procedure
    loads = [capture.name for capture in procedure.validating]
    runs = {"dynamic": procedure.dynamic, "static": procedure.static}
    means = {kind: [predictions[name].mean_percent for name in loads] for kind, predictions in runs.items()}
    rows = tuple(
        (
            f"estimated {kind} model",
            number(printed_values.TABLE_13[kind]),
            number(float(np.mean(values)), 3),
            number(max(values), 3),
        )
        for kind, values in means.items()
    )
    verdict, claim_results = experiment.verdict_on_claims(
        "dynamic against static, ratio", "dynamic against static, order"
    )
    return Table(
        "13",
        "Dynamic and static model, experiment: mean error of the output voltage [%]",
        ("model", "printed", "mean over the loads", "worst load"),
        rows,
        verdict,
        f"{experiment.data_note} {claim_results}The static model is frozen at SOC {STATIC_SOC:g}; the thesis does not print its own. "
        "The printed 0.003 % of the dynamic model is a hundredth of the errors of Table 11, so that its definition must differ.",
    )


TABLES: dict[str, Callable[[Experiment], Table]] = {
    "8": table_8,
    "9": table_9,
    "10": table_10,
    "11": table_11,
    "13": table_13,
}
