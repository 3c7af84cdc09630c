"""Comparison of the cell file that ``cell export`` writes after two weeks with a generic and a laboratory file.

``python -m tests.benchmarks.weeks.exported_file`` prints the table of docs/cell/index.md: RMSE of the SOC, fraction of time
inside two std, mean std and interval score, all in %. The test days have another use of the same packs, and begin with a wrong
SOC. The laboratory file is that of another cell of the type.
"""

import argparse
import itertools
import sys
from pathlib import Path

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import identified_cell
from bms_estimator.model.cell import CellModel
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.conftest import SHARED_DATA
from tests.estimator.anywhere.score import Score, score
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.cases import Case
from tests.estimator.month.groups import mean_score
from tests.estimator.month.packs import draw_pack, generator
from tests.estimator.month.run import run_blocks
from tests.estimator.month.simulation import simulate_use
from tests.estimator.month.sources import measure
from tests.estimator.month.uses import USES

CELLS = ("LG M50", "PF", "A123")
DAYS = (1, 2, 3)
"""Seeds of the days on which the files are compared."""
SOC_ERRORS = (0.2, -0.2)
"""Errors of the initial SOC."""


def learned_cell(case: Case, data: Path) -> CellModel:
    """Return the cell that ``cell export`` writes at the end of a case."""
    recording = case.draw(data)
    estimator = Estimator(recording.cell, voltage_resolution_v=case.source.volt_step, sampling=case.source.sampling)
    run_blocks(SlowFit(estimator, interval_s=DAY_S), recording.samples)
    return identified_cell(estimator, recording.cell, 1)


def score_of_another_day(case: Case, file: CellModel, day: int, soc_error: float, data: Path) -> Score:
    """Return the score of a day of the case's pack in the use ``never_full``.

    Args:
        case: Case with pack and source; its use is ignored.
        file: Cell file of the estimator.
        day: Seed of the use.
        soc_error: Error of the initial SOC.
        data: Folder of the real captures.
    """
    pack = draw_pack(case.cell, case.declared_ah, case.seed, data)
    history = simulate_use(pack, USES["never_full"], case.aging, 1, generator(case.cell, "another day", day))
    samples = measure(case.source, history, generator(case.cell, "source of another day", day))
    estimator = Estimator(
        file,
        voltage_resolution_v=case.source.volt_step,
        sampling=case.source.sampling,
        initial_soc=float(np.clip(history["soc"][0] + soc_error, 0.0, 1.0)),
    )
    trace = estimator.run(samples)
    result = score(trace["time_s"], trace["soc"], trace["soc_std"], history["soc"])
    assert result is not None
    return result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.weeks.exported_file", description=__doc__)
    parser.add_argument("cells", nargs="*", default=CELLS)
    parser.add_argument("--days", type=int, default=14, help="days of use before the export")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3], help="seeds of the packs")
    parser.add_argument("--data", type=Path, default=SHARED_DATA, metavar="FOLDER", help="folder of the real captures")
    options = parser.parse_args()
    sys.stdout.write("| cell | generic file | exported file | laboratory file |\n|---|---|---|---|\n")
    for name in options.cells:
        cases = [Case(name, "full_weekly", days=options.days, seed=seed) for seed in options.seeds]
        by_seed = [scores_by_file(case, options.data) for case in cases]
        of_each_file = [list(itertools.chain(*scores)) for scores in zip(*by_seed, strict=True)]
        sys.stdout.write(f"| {' | '.join([name, *map(entry, of_each_file)])} |\n")
        sys.stdout.flush()


def scores_by_file(case: Case, data: Path) -> list[list[Score]]:
    """Return the scores of the test days of one pack with the generic, the exported and the laboratory file."""
    pack = draw_pack(case.cell, case.declared_ah, case.seed, data)
    laboratory_file = pack.own_file(generator(case.cell, "own file", case.seed))
    return [
        [score_of_another_day(case, file, day, soc_error, data) for day in DAYS for soc_error in SOC_ERRORS]
        for file in (pack.generic_file, learned_cell(case, data), laboratory_file)
    ]


def entry(scores: list[Score]) -> str:
    """Return the mean of scores as text."""
    s = mean_score(scores)
    assert s is not None
    return f"{s.rmse:.2f} / {s.cover:.0f} / {s.std:.1f} / {s.score:.1f}"


if __name__ == "__main__":
    main()
