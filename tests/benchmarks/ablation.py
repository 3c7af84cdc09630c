"""Value of each part of the filter: the table of ``make anywhere`` without it, by kinds of groups.

One part at a time is switched off in the filter's settings, in its first state or in what it sees; the cell files stay.
Each cell of the table: RMSE, share of time inside two std, interval score, all in %.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import CURVE_SOC
from bms_estimator.kernels.cell_model.rc_ladder import GRID, REFERENCE_C
from bms_estimator.kernels.kalman_filter.mixture import copy_hypothesis, mixture_moments
from bms_estimator.kernels.kalman_filter.records import HYPOTHESES, SOC
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.recipes import GROUPS, Group, chosen, runs
from tests.estimator.anywhere.score import Score, score

Change = Callable[[np.void], None]

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


def setting(**values: float) -> Change:
    """Change settings of the filter, ``p``."""

    def change(p: np.void) -> None:
        for name, value in values.items():
            p[name] = value

    return change


def known_resistances_of_the_middle(p: np.void) -> None:
    """Make the resistances independent of SOC, with their values at mid SOC."""
    for name in ("weak_ohm", "strong_ohm"):
        p[name] = p[name][GRID // 2]


PARTS: dict[str, Change] = {
    "nothing": setting(),
    "large R (5 mV instead of 50)": setting(model_v=0.005),
    "biases": setting(bias_relative=0.0, bias_grown=0.0, bias_soc=0.0),
    "error of R over SOC": setting(bias_soc=0.0),
    "error of grown resistances": setting(bias_grown=0.0),
    "learned scales of R": setting(r_std=1e-6),
    "R over SOC": known_resistances_of_the_middle,
    "error outside the file's temperatures": setting(low_c=-100.0, high_c=200.0),
    "entropy": setting(per_kelvin_v=0.0),
    "error of the OCV": setting(curve_error_v=0.0),
    "learned OCV": setting(learned=0.0),
    "larger error at the knees of the OCV": setting(curve_soc=CURVE_SOC),
    "hysteresis": setting(hysteresis_v=0.0),
    "offset": setting(offset_c=0.0),
    "offset from rests": setting(zero_std_c=1.0),
    "error of the capacity": setting(capacity_std=0.0),
    "drift of offset and capacity": setting(offset_s=1e12, aged_soc=1e9),
    "unknown load before switch-on": setting(load_c=0.0, load_level_c=1e-3),
    "tempered weights": setting(half_likelihood_exponent=0.5),
    "reduced innovation variance in weights": setting(min_innovation_scale=1.0),
    "penalty for large biases": setting(inconsistency_penalty=0.0),
}
ONE_FILTER, NO_TEMPERATURE = "filter bank (one hypothesis)", "temperature"


def main() -> None:
    """Print the table; arguments are parts of the names of kinds."""
    kinds = {k: v for k, v in KINDS.items() if not sys.argv[1:] or any(part in k for part in sys.argv[1:])}
    table = Table("without", *kinds, title="RMSE / inside / score in %")
    with tempfile.TemporaryDirectory() as folder:
        for part in (*PARTS, ONE_FILTER, NO_TEMPERATURE):
            cells = []
            for begins in kinds.values():
                groups = [g for g in chosen(GROUPS, []) if any(belongs(g, begin) for begin in begins)]
                found = np.array([[s.rmse, s.cover, s.score] for g in groups for s in scores(g, part, Path(folder))])
                cells.append("{:.2f} / {:.0f} / {:.1f}".format(*found.mean(axis=0)))
            table.add_row(part, *cells)
    Console(width=None if sys.stdout.isatty() else 200).print(table)


def belongs(group: Group, begin: str) -> bool:
    """Return whether a group's name begins with the text."""
    return group.name == begin or (group.name.startswith(begin) and begin not in {g.name for g in GROUPS})


def scores(group: Group, part: str, folder: Path) -> list[Score]:
    """Return the scores of every run of a group."""
    found = [judge(part, *run) for run in runs(group, folder)]
    return [s for s in found if s is not None]


def judge(part: str, cell: CellModel, seen: SampleBlock, truth: Floats, start_soc: float) -> Score | None:
    """Score one run with a part of the filter removed."""
    estimator = Estimator(cell, initial_soc=start_soc)
    PARTS.get(part, setting())(estimator.settings_record[0]["filter"])
    if part == NO_TEMPERATURE:
        seen = seen.copy()
        seen["temperature_c"] = REFERENCE_C
    begun = estimator.run(seen[:1])
    if part == ONE_FILTER:
        unite_all(estimator.record[0]["filter"], estimator.settings_record[0]["filter"])
    trace = np.concatenate([begun, estimator.run(seen[1:])])
    true = np.interp(trace["time_s"], seen["time_s"], truth)
    return score(trace["time_s"], trace["soc"], trace["soc_std"], true)


def unite_all(s: np.void, p: np.void) -> None:
    """Replace all hypotheses by the middle one, with the standard deviation of all."""
    if s["count"] == HYPOTHESES:
        copy_hypothesis(s, HYPOTHESES // 2, 0)
        s["count"], s["best"] = 1, 0
        s["ln_weight"][0] = 0.0
        s["covariance"][0, SOC, SOC] = p["soc_std"] ** 2
        mixture_moments(s)


if __name__ == "__main__":
    main()
