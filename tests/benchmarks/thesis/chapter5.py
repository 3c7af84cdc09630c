"""Chapter 5 of the thesis on every real cell with suitable captures: ``make chapter5``.

Numbers in parentheses are equations of the thesis.
"""

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.ocv.chen_mora_fit import pool_tests
from bms_estimator.calibration.thesis.series_resistance import SeriesResistance, SeriesResistanceFit
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.reports.thesis import printed_values
from bms_estimator.reports.thesis.experiment import CLAIMS, claim, products
from bms_estimator.reports.thesis.procedure import KNEE_SOC, Capture, Kind, Procedure
from bms_estimator.sources.captures.replay import load_capture
from tests.benchmarks.recipes import DATA, LFP, NCR, PF, charge_ah, path_of

WIDTH = 150
"""Width of the printed tables [characters]."""
RELAXATION, CONSTANT, STEPS = Kind
"""Kinds of captures: relaxation test, constant load, load in steps."""


@dataclass(frozen=True)
class Experiment:
    """One cell at one temperature.

    Attributes:
        name: Name in the table.
        cell: Cell file, of which only the limits are used.
        capacity_ah: Capacity by the captures, counted from full [Ah].
        captures: Name and kind of each capture.
        room: True if measured at room temperature, as in the experiments of the thesis.
    """

    name: str
    cell: str
    capacity_ah: float
    captures: tuple[tuple[str, Kind], ...]
    room: bool = True


def _panasonic(name: str, index: str, *captures: tuple[str, Kind]) -> Experiment:
    """Return the experiment of the Panasonic cell at one temperature.

    Its HPPC (pulses and discharges, with a rest after each) is the relaxation test.
    """
    all_captures = tuple((f"{PF}{index}_{capture}", kind) for capture, kind in (("hppc", RELAXATION), *captures))
    return Experiment(f"18650PF {name}", "nca", 2.9, all_captures, room=index == "25")


def _a123(name: str, index: str) -> Experiment:
    """Return the experiment of the A123 cell at one temperature.

    Drive cycles with a rest of 5 min each half hour are the relaxation test. The constant load is C/30.
    """
    captures = ((f"{LFP}dyn_{index}", RELAXATION), (f"{LFP}c30_dis_{index}", CONSTANT))
    return Experiment(f"A123 {name}", "lfp", 2.05, captures, room=index == "p25")


EXPERIMENTS = (
    Experiment(
        "NCR18650 cell 1, OCV of cell 5",
        "ncr18650",
        3.0,
        (
            (NCR + "cell5_relaxation_c2", RELAXATION),
            (NCR + "cell1_discharge_c20", CONSTANT),
            (NCR + "cell1_discharge_c4", CONSTANT),
            (NCR + "cell1_discharge_1c5", CONSTANT),
            (NCR + "cell1_hppc", STEPS),
            (NCR + "cell1_random_steps", STEPS),
            (NCR + "cell1_dst", STEPS),
        ),
    ),
    Experiment(
        "NCR18650 cell 5",
        "ncr18650",
        3.0,
        (
            (NCR + "cell5_relaxation_c2", RELAXATION),
            (NCR + "cell5_hppc", STEPS),
            (NCR + "cell5_random_steps", STEPS),
        ),
    ),
    _panasonic("25 C", "25", ("c20", CONSTANT), ("us06", STEPS), ("cycle1", STEPS)),
    _panasonic("10 C", "10", ("us06", STEPS)),
    _panasonic("0 C", "0", ("us06", STEPS), ("cycle1", STEPS)),
    _panasonic("-10 C", "n10", ("us06", STEPS)),
    Experiment("Leaf", "leaf", 30.5, (("leaf/hppc_25c_from_full", RELAXATION), ("leaf/cc_1c", CONSTANT))),
    _a123("25 C", "p25"),
    _a123("5 C", "p05"),
    _a123("-15 C", "n15"),
)
"""Experiments. The LG M50 is not among them, because it has no relaxation test for step 1."""
MIN_LOAD_C = 0.01
"""Minimum current of a charge or discharge [C-rate]."""
VOLTAGE_STEP_V = 1e-3
"""Resolution of the voltage in the captures [V]."""
ROOM = [experiment.name for experiment in EXPERIMENTS if experiment.room]
"""Names of the experiments at room temperature."""
R_S_SOC = (0.98, 0.9, 0.7, 0.5, 0.3, 0.1, 0.05)
"""SOC values at which R_s is printed."""
MIDDLE_SOC = 0.5
"""SOC near which the residual of the OCV fit (2.10) is printed."""


def make_procedure(experiment: Experiment) -> Procedure:
    """Return the procedure of the thesis on one cell. Captures of a constant load are limited to the discharge."""
    cell = load_cell(experiment.cell, experiment.capacity_ah)
    captures = [
        Capture(name.split("/")[1], kind, _samples(name, kind, experiment)) for name, kind in experiment.captures
    ]
    return Procedure(cell, captures, VOLTAGE_STEP_V)


def _samples(name: str, kind: Kind, experiment: Experiment) -> SampleBlock:
    """Return the used samples of a capture."""
    rows = load_capture(path_of(name)).rows
    return discharge(rows, MIN_LOAD_C * experiment.capacity_ah) if kind is Kind.CONSTANT else rows


def discharge(rows: SampleBlock, min_a: float) -> SampleBlock:
    """Return the largest discharge between two charges, until its last sample under load.

    A current below ``min_a`` is neither charge nor discharge [A].
    """
    # The rows are split at the beginning and the end of each charge.
    edges = np.r_[0, np.flatnonzero(np.diff((rows["current_a"] < -min_a).astype(np.int8))) + 1, rows.size]
    parts_between_charges = [rows[first:end] for first, end in itertools.pairwise(edges)]
    largest_discharge = max(parts_between_charges, key=lambda part: charge_ah(part)[-1])
    return largest_discharge[: int(np.flatnonzero(largest_discharge["current_a"] > min_a)[-1]) + 1]


def load_rows(name: str, p: Procedure) -> Iterator[tuple[str, ...]]:
    """Yield a row of the table of errors for each load of a cell."""
    validating = [capture.name for capture in p.validating]
    for load, run in p.dynamic.items():
        aligned, above = run.aligned, run.above(KNEE_SOC)
        soc, _ = p.interpolate_soc(load)
        yield (
            name,
            load,
            "validation" if load in validating else "step 2",
            f"{run.mean_percent:.2f}",
            f"{run.max_percent:.1f}",
            f"{run.soc[aligned][np.argmax(run.error_percent[aligned])]:.2f}",
            f"{above.mean_percent:.2f}",
            f"{above.max_percent:.1f}",
            f"{p.static[load].mean_percent:.2f}",
            f"{100.0 * np.sqrt(np.mean((soc - run.soc) ** 2)):.1f}",
        )


def main() -> None:
    """Print errors by load, the outcomes of the steps by cell, the verdicts, and the variants."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    console = Console(width=WIDTH)
    procedures = {experiment.name: make_procedure(experiment) for experiment in EXPERIMENTS}
    console.print(errors(procedures))
    console.print(parameters(procedures))
    first_cell = EXPERIMENTS[0].name
    variants_of_first = variants(EXPERIMENTS[0], procedures[first_cell])
    console.print(resistances(first_cell, variants_of_first))
    console.print(largest_errors(first_cell, procedures[first_cell]))
    console.print(ablation(first_cell, variants_of_first))
    for captures_text, names in (("all captures", list(procedures)), ("captures at room temperature", ROOM)):
        console.print(verdicts(captures_text, [procedures[name] for name in names]))
    console.print(steps_by_variant(procedures))


def errors(procedures: dict[str, Procedure]) -> Table:
    """Return the table of voltage errors, which the thesis prints in its Tables 11 and 13."""
    printed_means = ", ".join(f"{load} {value}" for load, value in printed_values.TABLE_11.items())
    table = Table(
        title=f"error of the voltage in %; printed means: {printed_means}; largest {printed_values.MAX_CONSTANT} (constant), "
        f"{printed_values.MAX_STEPS} (steps); static {printed_values.TABLE_13['static']}, dynamic {printed_values.TABLE_13['dynamic']}"
    )
    heads = (
        "mean",
        "max",
        "at SOC",
        f"mean, SOC > {KNEE_SOC}",
        f"max, SOC > {KNEE_SOC}",
        "static",
        "SOC by E_o, RMS %",
    )
    for column in ("cell", "load", "serves"):
        table.add_column(column)
    for column in heads:
        table.add_column(column, justify="right")
    for name, p in procedures.items():
        for row in load_rows(name, p):
            table.add_row(*row)
    return table


def parameters(procedures: dict[str, Procedure]) -> Table:
    """Return the table of the results of steps 1 to 3 of the procedure."""
    table = Table(title="steps 1 to 3")
    residual = f"residual in mV, nearest SOC {MIDDLE_SOC}"
    heads = ("cell", "step 1: points", residual, "step 2 on", "outcome", "a13..a15 in ohm, -, ohm")
    for column in (*heads, "RC products in s", "of the rests in s"):
        table.add_column(column, overflow="fold")
    for name, p in procedures.items():
        residual_v, rc_products = p.joint_fit.residual_v, list(products(p))
        middle_v = residual_v[np.argmin(np.abs(pool_tests(p.tests).soc - MIDDLE_SOC))]
        table.add_row(
            name,
            str(residual_v.size),
            f"{1e3 * np.sqrt(np.mean(residual_v**2)):.1f} / {1e3 * middle_v:.1f}",
            p.smallest.name,
            p.adaptive.outcome,
            ", ".join(f"{value:.4g}" for value in p.r_s_fit.a),
            ", ".join(f"{estimated_s:.3g}" for _, estimated_s, _ in rc_products),
            ", ".join(f"{rest_s:.3g}" for _, _, rest_s in rc_products),
        )
    return table


def verdicts(captures_text: str, procedures: list[Procedure]) -> Table:
    """Return the verdict on each claim over the captures of several cells."""
    table = Table(title=f"claims on {captures_text}; each must be met on more than half of them")
    for column in ("claim", "where", "criterion", "met", "found", "verdict"):
        table.add_column(column)
    for key, *outcome in outcomes(procedures):
        where, criterion, _ = CLAIMS[key]
        table.add_row(key, where, criterion, *outcome)
    return table


def outcomes(procedures: list[Procedure]) -> Iterator[tuple[str, str, str, str]]:
    """Yield for each claim: key, number of cells that meet it, range of the values, verdict."""
    for key in CLAIMS:
        result = claim(key, procedures)
        yield key, f"{result.captures_met} of {len(result.results)}", result.span, result.verdict.value


class FastInStep3(Procedure):
    """Procedure in which constant loads of any current contribute to R_s in step 3."""

    @property
    def step_3(self) -> list[Capture]:
        """Return all constant loads and the relaxation tests."""
        return self.captures_of(Kind.CONSTANT, Kind.RELAXATION)


class ValidatedLoadInStep3(FastInStep3):
    """Procedure in which a load also contributes to the R_s with which it is validated."""

    def r_s_without(self, name: str) -> SeriesResistanceFit:  # noqa: ARG002 - none is left out
        """Return the fit that includes the load."""
        return self.r_s_fit


class Unweighted(Procedure):
    """Procedure with the unweighted mean of (4.2), as printed, for any current (erratum 19)."""

    @cached_property
    def r_s_curves(self) -> dict[str, SeriesResistance]:
        """Return the values with equal weights."""
        return {name: replace(curve, weight=np.ones_like(curve.weight)) for name, curve in super().r_s_curves.items()}


class PrintedSign(Unweighted):
    """Procedure with the unweighted mean of (4.2) with its printed sign (erratum 19).

    With this sign R_s is negative, so that the fit limits it to zero.
    """

    @cached_property
    def r_s_curves(self) -> dict[str, SeriesResistance]:
        """Return the negated values."""
        return {name: replace(curve, r_s_ohm=-curve.r_s_ohm) for name, curve in super().r_s_curves.items()}


# names of the variants; "as it is" is the procedure without changes
AS_IT_IS, UNWEIGHTED, FAST = "as it is", "(4.2) not weighted by the current", "1.5C in step 3 of the other loads"
VARIANTS = {UNWEIGHTED: Unweighted, FAST: FastInStep3, "each load in its own step 3 as well": ValidatedLoadInStep3}


def variants(experiment: Experiment, default_procedure: Procedure) -> dict[str, Procedure]:
    """Return variants of a procedure, with other versions of step 3 or other bounds."""
    model = load_cell(experiment.cell, experiment.capacity_ah)
    bounds = {f"a{i}": model.bounds(i) for i in range(1, 13)}
    model_with_bounds = model.model_copy(update={"adaptation": bounds})
    return {
        AS_IT_IS: default_procedure,
        **{name: variant(model, default_procedure.captures, VOLTAGE_STEP_V) for name, variant in VARIANTS.items()},
        "bounds around the cell file's elements": Procedure(
            model_with_bounds, default_procedure.captures, VOLTAGE_STEP_V
        ),
    }


STEP_3_VARIANTS = {
    AS_IT_IS: Procedure,
    UNWEIGHTED: Unweighted,
    "(4.2) as printed: its sign, not weighted": PrintedSign,
    FAST: FastInStep3,
}
"""Variants of step 3 for the claim of Table 11 on steps."""


def steps_met(procedures: dict[str, Procedure]) -> Iterator[tuple[str, str, str]]:
    """Yield for each variant of step 3 the numbers of cells that meet the printed mean error under steps.

    The first number is over all captures, the second over those at room temperature.
    """
    for variant_name, variant in STEP_3_VARIANTS.items():
        changed = {name: variant(p.cell, p.captures, VOLTAGE_STEP_V) for name, p in procedures.items()}
        claims = (claim("steps, mean", [changed[name] for name in names]) for names in (list(changed), ROOM))
        yield variant_name, *(f"{each_claim.captures_met} of {len(each_claim.results)}" for each_claim in claims)


def steps_by_variant(procedures: dict[str, Procedure]) -> Table:
    """Return the table of the claim of Table 11 on steps, by variants of step 3."""
    table = Table(title="mean error under steps at most as printed, by step 3")
    for column in ("step 3", "all captures", "room temperature"):
        table.add_column(column)
    for row in steps_met(procedures):
        table.add_row(*row)
    return table


def ablation(name: str, variants_of_first: dict[str, Procedure]) -> Table:
    """Return the table of the errors on one cell with each variant."""
    table = Table(title=f"{name}: mean / largest error in % when one thing is done otherwise")
    loads = [capture.name for capture in variants_of_first[AS_IT_IS].validating]
    for column in ("", *loads):
        table.add_column(column, justify="right")
    for variant_name, p in variants_of_first.items():
        load_runs = (p.dynamic[load] for load in loads)
        table.add_row(variant_name, *(f"{run.mean_percent:.2f} / {run.max_percent:.1f}" for run in load_runs))
    return table


def resistances(name: str, variants_of_first: dict[str, Procedure]) -> Table:
    """Return R_s over SOC by (4.2) for each load of a cell, and by the fit to their mean."""
    table = Table(title=f"{name}: R_s by (4.2) in mohm, by SOC; its fit (2.9)")
    for column in ("load", "its current in A", *map(str, R_S_SOC)):
        table.add_column(column, justify="right")
    min_a = MIN_LOAD_C * variants_of_first[FAST].cell.cell.capacity_ah
    loaded_a = {c.name: c.samples["current_a"][c.samples["current_a"] > min_a] for c in variants_of_first[FAST].step_3}
    for load, curve in variants_of_first[FAST].r_s_curves.items():
        r_s_ohm = np.interp(R_S_SOC, curve.soc, curve.r_s_ohm)
        table.add_row(load, f"{np.median(loaded_a[load]):.3f}", *(f"{1e3 * ohm:.0f}" for ohm in r_s_ohm))
    for variant_name in (AS_IT_IS, UNWEIGHTED):
        fitted_ohm = variants_of_first[variant_name].r_s_fit(np.array(R_S_SOC))
        table.add_row(f"fit, {variant_name}", "", *(f"{1e3 * ohm:.0f}" for ohm in fitted_ohm))
    return table


def largest_errors(name: str, p: Procedure) -> Table:
    """Return the table of the largest error of each load of one cell."""
    table = Table(title=f"{name}: where the largest error is")
    for column in ("load", "at SOC", "measured in V", "less predicted in V", "current in A"):
        table.add_column(column, justify="right")
    for load, run in p.dynamic.items():
        index = np.flatnonzero(run.aligned)[np.argmax(run.error_percent[run.aligned])]
        table.add_row(
            load,
            f"{run.soc[index]:.2f}",
            f"{run.voltage_v[index]:.2f}",
            f"{run.error_v[index]:.2f}",
            f"{run.current_a[index]:.2f}",
        )
    return table


if __name__ == "__main__":
    main()
