"""Error of the SOC after a start at any point of real captures, compared with other methods.

Cell files come from the commands `ocv` and `identify`. The estimator starts in mid-load, or at the start of the capture for some groups,
with an initial SOC 0.2 too low or 0.2 too high. Results are scored from 15 min after the start on, above SOC 0.05, weighted
by time:

- RMSE: error of the SOC; mean and worst run [%]. The true SOC is counted, or comes with the capture
- inside: fraction of time with the true SOC inside soc +- 2 soc_std; mean and worst run [%]
- std: mean of soc_std [%]
- score: interval score of this interval as a 95 % interval: width plus 40 times the distance outside; smaller is better [%]
- NIS: normalized innovation squared, of means of the innovation over ten minutes; 1 if the variance of the filter is correct

"Its own file" marks groups whose capture was also used for the cell file, because the cell has no other capture.

The other methods have the same cell file: a textbook EKF (two RC pairs with constant elements, 5 mV of noise), an EKF with
five time constants, resistances over SOC and temperature and the measurement noise with the best result, and coulomb counting
from the OCV of the first sample.
"""

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import filter_settings
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.settings.observer import IdentifierSettings
from tests.benchmarks.ekf import FIVE_TAU_S, five_branches, fixed_ekf, ladder_ekf
from tests.benchmarks.pulses import pulse_table
from tests.benchmarks.recipes import GROUPS, Group, charge_ah, chosen, runs
from tests.estimator.anywhere import cycles
from tests.estimator.anywhere.run import run_of
from tests.estimator.anywhere.score import Score, score


@dataclass(frozen=True)
class Outcome:
    """Result of one run by each method."""

    ours: Score
    nis: float
    textbook_ekf: Score
    five_tau_ekf: Score
    counting: Score


def main() -> None:
    """Print the table of the groups whose name contains an argument, or all."""
    console = Console(width=None if sys.stdout.isatty() else 160)
    table = Table(title="switched on anywhere: RMSE/worst, inside/worst, std, score in %")
    table.add_column("group")
    for column in ("RMSE", "inside", "std", "score", "NIS", "EKF", "inside", "score", "5-tau EKF", "inside", "score"):
        table.add_column(column, justify="right")
    table.add_column("counting", justify="right")
    with tempfile.TemporaryDirectory() as folder:
        for group in chosen(GROUPS, sys.argv[1:]):
            table.add_row(group.name, *table_cells(list(outcomes(group, Path(folder)))))
        console.print(table)
        console.print(cycle_table(sys.argv[1:]))
        console.print(pulse_table(Path(folder), sys.argv[1:]))


def cycle_table(names: list[str]) -> Table:
    """Return the table of simulated full cycles and charges from empty, one row for each generic cell that matches ``names``."""
    table = Table(title="full cycles and charges from empty, simulated: RMSE/worst, inside/worst, std, score in %")
    for column in ("generic cell", "RMSE", "inside", "std", "score"):
        table.add_column(column)
    for chemistry in cycles.CHEMISTRIES:
        if not names or any(name.lower() in f"cycles {chemistry}" for name in names):
            scores = [row.score for row in cycles.rows(chemistry)]
            rmse, cover = [s.rmse for s in scores], [s.cover for s in scores]
            table.add_row(
                chemistry,
                f"{np.sqrt(np.mean(np.square(rmse))):.1f}/{max(rmse):.1f}",
                f"{mean(cover):.0f}/{min(cover):.0f}",
                f"{mean([s.std for s in scores]):.1f}",
                f"{mean([s.score for s in scores]):.1f}",
            )
    return table


def table_cells(outcomes_of_group: list[Outcome]) -> Iterator[str]:
    """Yield the cells of one table row."""
    ours = [o.ours for o in outcomes_of_group]
    yield f"{mean([s.rmse for s in ours]):.2f}/{max(s.rmse for s in ours):.2f}"
    yield f"{mean([s.cover for s in ours]):.0f}/{min(s.cover for s in ours):.0f}"
    yield f"{mean([s.std for s in ours]):.2f}"
    yield f"{mean([s.score for s in ours]):.2f}"
    yield f"{mean([o.nis for o in outcomes_of_group]):.2f}"
    for scores in ([o.textbook_ekf for o in outcomes_of_group], [o.five_tau_ekf for o in outcomes_of_group]):
        yield f"{mean([s.rmse for s in scores]):.2f}"
        yield f"{mean([s.cover for s in scores]):.0f}"
        yield f"{mean([s.score for s in scores]):.1f}"
    yield f"{mean([o.counting.rmse for o in outcomes_of_group]):.2f}"


def mean(values: list[float]) -> float:
    """Return the arithmetic mean."""
    return float(np.mean(values))


def outcomes(group: Group, folder: Path) -> Iterator[Outcome]:
    """Yield the outcomes of every capture and start of a group, except of captures that are too short."""
    for run in runs(group, folder):
        outcome = compare(*run)
        if outcome is not None:
            yield outcome


def compare(cell: CellModel, samples: SampleBlock, truth: Floats, start_soc: float) -> Outcome | None:
    """Run each method once. Return None if the capture is too short."""
    run = run_of(Estimator(cell, initial_soc=start_soc), samples)
    ours = score(samples["time_s"], run.soc, run.soc_std, truth)
    if ours is None:
        return None
    grid = np.array(ocv_grid(cell))
    ocv_soc = float(Estimator(cell, initial_soc=start_soc).run(samples[:1])["soc_ocv"][0])
    counted_soc = ocv_soc - charge_ah(samples) / cell.cell.capacity_ah
    estimates = (
        run_textbook_ekf(cell, samples, start_soc, grid),
        run_five_tau_ekf(cell, samples, start_soc, grid),
        (counted_soc, np.full(samples.size, np.nan)),
    )
    scores = [score(samples["time_s"], *estimate, truth) for estimate in estimates]
    assert None not in scores
    return Outcome(ours, run.nis(900.0), *scores)


def run_textbook_ekf(cell: CellModel, samples: SampleBlock, start_soc: float, grid: Floats) -> tuple[Floats, Floats]:
    """Return SOC and its standard deviation by the EKF with two RC pairs."""
    a = cell.a
    r_s, r1, c1, r2, c2 = (
        f(0.5, a) for f in (chen_mora.r_s, chen_mora.r_ts, chen_mora.c_ts, chen_mora.r_tl, chen_mora.c_tl)
    )
    model = np.array([3600.0 * cell.cell.capacity_ah, r_s, r1, r1 * c1, r2, r2 * c2])
    time_s, current_a, voltage_v = (np.ascontiguousarray(samples[n]) for n in ("time_s", "current_a", "voltage_v"))
    return fixed_ekf(time_s, current_a, voltage_v, start_soc, model, grid)


def run_five_tau_ekf(cell: CellModel, samples: SampleBlock, start_soc: float, grid: Floats) -> tuple[Floats, Floats]:
    """Return SOC and its standard deviation by the EKF with five time constants."""
    p = filter_settings(cell, (grid[0], grid[1]), IdentifierSettings(), 1e-3, None)[0]
    ohm, energy_j = five_branches(p["weak_ohm"], p["strong_ohm"])
    columns = [np.ascontiguousarray(samples[n]) for n in ("time_s", "current_a", "voltage_v", "temperature_c")]
    columns[3] = np.where(np.isfinite(columns[3]), columns[3], 25.0)
    return ladder_ekf(*columns, start_soc, 3600.0 * cell.cell.capacity_ah, ohm, energy_j, FIVE_TAU_S, grid)


if __name__ == "__main__":
    main()
