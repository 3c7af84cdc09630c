"""Ablation study of the filter: scores of ``make anywhere`` without one part of the filter, by kinds of groups.

One part at a time is disabled: by the settings of the filter, by its first state, or by its samples. The cell files are not
changed. Each entry of the table has RMSE of the SOC, fraction of time inside two std, and interval score, all in %.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import CURVE_SOC
from bms_estimator.kernels.cell_model.rc_ladder import GRID, REFERENCE_C
from bms_estimator.kernels.kalman_filter.hypotheses import MAX_STD_OF_ONE_HYPOTHESIS, spawn_hypotheses
from bms_estimator.kernels.kalman_filter.mixture import mixture_moments
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION
from bms_estimator.kernels.kalman_filter.records import SOC
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from tests.benchmarks.recipes import GROUPS, Group, chosen, runs
from tests.estimator.anywhere.score import Score, score

Change = Callable[[np.void], None]
"""Function that changes the settings of the filter."""

KINDS = {
    "NMC/NCA, 25, 10 C": ("PF 25 C, US06", "PF 25 C, mixed", "PF 10 C", "NCR", "Leaf"),
    "NMC/NCA, 0, -10 C": ("PF 0 C", "PF -10 C", "PF 0 C from full", "PF -10 C from full"),
    "file of 25 C": tuple(f"PF {t} C, file of 25" for t in (10, 0, -10)),
    "sensor errors": ("NCR, current", "NCR, -50", "NCR, +50", "NCR, capacity"),
    "LFP from full": tuple(f"LFP {t} C from full" for t in (25, 5, -15)),
    "LFP": ("LFP 25 C (its", "LFP 5 C", "LFP -15 C (its"),
    "by ocv alone": (
        *(f"PF {t} C, by ocv" for t in (25, 10, 0, -10)),
        *(f"LFP {t} C, by ocv" for t in (25, 5, -15)),
        "NCR, by ocv",
        "LG M50, by ocv",
    ),
    "charging": ("NCR, charging", "LG M50, charging", *(f"LFP {t} C, charging" for t in (25, 5, -15))),
    "generic": ("generic",),
}
"""Groups by the beginning of their names; a full name selects one group."""


def change_settings(**values: float) -> Change:
    """Return a function that changes these settings of the filter."""

    def change(p: np.void) -> None:
        for name, value in values.items():
            p[name] = value

    return change


def use_resistances_of_mid_soc(p: np.void) -> None:
    """Use the resistances at SOC 0.5 for all SOCs."""
    for name in ("weak_ohm", "strong_ohm"):
        p[name] = p[name][GRID // 2]


def let_ocv_error_vary(p: np.void) -> None:
    """Let the whole error of the OCV vary, so that none of it is learned."""
    p["constant_error_v"], p["varying_error_v"] = 0.0, p["curve_error_v"]


PARTS: dict[str, Change] = {
    "nothing": change_settings(),
    "large R (5 mV instead of 50)": change_settings(model_v=0.005),
    "biases": change_settings(bias_relative=0.0, bias_grown=0.0, bias_soc=0.0),
    "error of R over SOC": change_settings(bias_soc=0.0),
    "error of grown resistances": change_settings(bias_grown=0.0),
    "learned scales of R": change_settings(r_std=1e-6),
    "R over SOC": use_resistances_of_mid_soc,
    "error outside the file's temperatures": change_settings(low_c=-100.0, high_c=200.0),
    "entropy": change_settings(per_kelvin_v=0.0),
    "error of the OCV": change_settings(curve_error_v=0.0, constant_error_v=0.0, varying_error_v=0.0),
    "learned OCV": let_ocv_error_vary,
    "learned OCV and capacity": change_settings(learning_soc=0.0),
    "level of a plateau": change_settings(node_correlation=NODE_CORRELATION),
    "larger error at the knees of the OCV": change_settings(curve_soc=CURVE_SOC),
    "hysteresis": change_settings(hysteresis_v=0.0),
    "offset": change_settings(offset_c=0.0),
    "offset from rests": change_settings(zero_std_c=1.0),
    "error of the capacity": change_settings(capacity_std=0.0),
    "drift of offset and capacity": change_settings(offset_s=1e12, aged_soc=1e9),
    "unknown load before switch-on": change_settings(load_c=0.0, load_level_c=1e-3),
    "tempered weights": change_settings(half_likelihood_exponent=0.5),
    "reduced innovation variance in weights": change_settings(min_innovation_scale=1.0),
    "penalty for large biases": change_settings(inconsistency_penalty=0.0),
}
"""Part of the filter, and the change of the settings that disables it."""
ONE_FILTER, NO_TEMPERATURE = "filter bank (one hypothesis)", "temperature"
"""Two parts that no setting disables: the first is disabled in the first state, the second in the samples."""


def main() -> None:
    """Print the table of the kinds whose name contains an argument, or of all."""
    kinds = {k: v for k, v in KINDS.items() if not sys.argv[1:] or any(part in k for part in sys.argv[1:])}
    table = Table("without", *kinds, title="RMSE / inside / score in %")
    with tempfile.TemporaryDirectory() as folder:
        for part in (*PARTS, ONE_FILTER, NO_TEMPERATURE):
            cells = []
            for prefixes in kinds.values():
                groups = [g for g in chosen(GROUPS, []) if any(belongs(g, prefix) for prefix in prefixes)]
                results = np.array([[s.rmse, s.cover, s.score] for g in groups for s in scores(g, part, Path(folder))])
                cells.append("{:.2f} / {:.0f} / {:.1f}".format(*results.mean(axis=0)))
            table.add_row(part, *cells)
    Console(width=None if sys.stdout.isatty() else 200).print(table)


def belongs(group: Group, prefix: str) -> bool:
    """Return True if ``prefix`` is the name of a group, or begins it and is not the full name of another group."""
    return group.name == prefix or (group.name.startswith(prefix) and prefix not in {g.name for g in GROUPS})


def scores(group: Group, part: str, folder: Path) -> list[Score]:
    """Return the scores of every run of a group."""
    results = [score_without(part, *run) for run in runs(group, folder)]
    return [s for s in results if s is not None]


def score_without(part: str, cell: CellModel, samples: SampleBlock, truth: Floats, start_soc: float) -> Score | None:
    """Score one run with a part of the filter removed."""
    estimator = Estimator(cell, initial_soc=start_soc)
    PARTS.get(part, change_settings())(estimator.settings_record[0]["filter"])
    if part == NO_TEMPERATURE:
        samples = samples.copy()
        samples["temperature_c"] = REFERENCE_C
    first_row = estimator.run(samples[:1])
    if part == ONE_FILTER:
        restart_with_one_hypothesis(estimator.record[0]["filter"], estimator.settings_record[0]["filter"], start_soc)
    trace = np.concatenate([first_row, estimator.run(samples[1:])])
    true_soc = np.interp(trace["time_s"], samples["time_s"], truth)
    return score(trace["time_s"], trace["soc"], trace["soc_std"], true_soc)


def restart_with_one_hypothesis(state: np.void, settings: np.void, start_soc: float) -> None:
    """Replace all hypotheses by one at the initial SOC, with the standard deviation that the SOC has over all of them."""
    spawn_hypotheses(state, settings, start_soc, MAX_STD_OF_ONE_HYPOTHESIS)
    state["covariance"][0, SOC, SOC] = settings["soc_std"] ** 2
    mixture_moments(state)


if __name__ == "__main__":
    main()
