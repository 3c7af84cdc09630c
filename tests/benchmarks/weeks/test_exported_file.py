"""The cell file that is exported after days of use, on another day of the same pack."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import identified_cell
from bms_estimator.model.cell import CellModel
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.conftest import SHARED_DATA
from tests.estimator.anywhere.cycles import total_ohm
from tests.estimator.anywhere.score import Score, score
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.cases import Case
from tests.estimator.month.packs import draw_pack, generator
from tests.estimator.month.run import run_blocks
from tests.estimator.month.simulation import simulate_use
from tests.estimator.month.sources import measure
from tests.estimator.month.uses import USES
from tests.fit_interval import fits_every

pytestmark = pytest.mark.thorough

CASES = (
    Case("LG M50", "full_nightly", days=3),
    Case("LG M50", "full_nightly", days=4, seed=2),
    Case("LFP", "full_weekly", days=4),
)
"""Runs after which the file is exported."""


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


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case.cell}, seed {case.seed}")
def learned(request) -> tuple[Case, CellModel]:
    """Return a case, and the cell that is exported after it."""
    with fits_every(DAY_S):
        return request.param, learned_cell(request.param, SHARED_DATA)


def test_the_exported_resistances_are_those_of_the_pack(learned) -> None:
    """The scales of the filter follow the load of the last hours: an earlier version exported resistances that were up to
    17 % too large, with a std of 3 to 6 %."""
    case, cell = learned
    truth = draw_pack(case.cell, case.declared_ah, case.seed, SHARED_DATA).truth
    error = total_ohm(cell) / truth.ohm[truth.ohm.shape[0] // 2].sum() - 1.0
    assert cell.ladder is not None
    assert abs(error) < min(0.1, 2.0 * cell.ladder.std)


def test_the_interval_of_a_service_with_the_exported_file_is_narrower_and_contains_the_soc(learned) -> None:
    case, cell = learned
    generic_cell = draw_pack(case.cell, case.declared_ah, case.seed, SHARED_DATA).generic_file
    generic, exported = (score_of_another_day(case, file, 1, -0.2, SHARED_DATA) for file in (generic_cell, cell))
    assert exported.cover > 95.0
    assert exported.std < 0.8 * generic.std
    assert exported.score < 0.8 * generic.score
