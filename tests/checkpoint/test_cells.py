"""State of the single cells in a checkpoint, over a restart of the service."""

from pathlib import Path

import numpy as np
import structlog

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.pack.pack import Pack
from bms_estimator.settings.pack import Settings
from tests.simulated_pack import SimulatedPack


def saved_checkpoint(folder: Path, pack: SimulatedPack) -> StateFiles:
    """Save a checkpoint of a pack; return its files for the next run."""
    StateFiles(folder, Settings(), pack.model).save(pack.pack.state())
    return StateFiles(folder, Settings(), pack.model)


def restarted(files: StateFiles, pack: SimulatedPack) -> CellEstimator:
    """Return the estimators of the cells of the next run."""
    estimator = Estimator(pack.model)
    cells = CellEstimator(estimator)
    files.restore(Pack(estimator, cells=cells))
    return cells


def test_deviations_of_cells_are_equal_after_a_restart(tmp_path: Path) -> None:
    pack = SimulatedPack()
    pack.run(2)
    cells = restarted(saved_checkpoint(tmp_path, pack), pack)
    assert cells.deviations
    assert pack.cells.deviations
    assert np.array_equal(cells.deviations.soc_deviation, pack.cells.deviations.soc_deviation)


def test_an_invalid_state_of_the_cells_is_dropped_with_a_reason_and_the_pack_is_restored(tmp_path: Path) -> None:
    pack = SimulatedPack()
    pack.run(1)
    pack.cells.cells["covariance"][2] = np.nan
    files = saved_checkpoint(tmp_path, pack)
    with structlog.testing.capture_logs() as lines:
        cells = restarted(files, pack)
    assert cells.deviations is None
    assert [line["outcome"] for line in lines if line["event"] == "cells"] == ["refused: a value is not finite"]
    assert any(line.get("outcome", "").startswith("restored") for line in lines)


def test_a_checkpoint_without_cell_voltages_starts_the_cells_anew(tmp_path: Path) -> None:
    pack = SimulatedPack()
    pack.run(1)
    files = StateFiles(tmp_path, Settings(), pack.model)
    files.checkpoint.save(pack.estimator.record)
    assert restarted(StateFiles(tmp_path, Settings(), pack.model), pack).deviations is None
