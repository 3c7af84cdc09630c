"""Changes since a checkpoint: small files between two whole saves."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.checkpoint.changes_file import BLOCK_BYTES, CHANGES_SUFFIXES, MAX_BASE_AGE_S, MAX_SOC_CHANGE
from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.model.arrays import fields
from bms_estimator.process.boot_timestamp import BootTimestamp
from tests.checkpoint.test_checkpoint import CELL, SETTINGS, learned_estimator


class SavedPack:
    """Pack whose state is saved whole at 0 s.

    Attributes:
        now_s: Time [s].
    """

    def __init__(self, folder: Path) -> None:
        self.now_s = 0.0
        self.estimator = learned_estimator()
        self.file = CheckpointFile(folder, SETTINGS, CELL, self.clock)
        self.file.save(self.estimator.record)
        self.whole_inode = self.file.path.stat().st_ino

    def clock(self) -> BootTimestamp:
        return BootTimestamp(1.7e9 + self.now_s, True, self.now_s, "one")

    def run(self, seconds: int) -> np.ndarray:
        """Discharge the pack by 0.3 A, and save it. Return its state."""
        time_s = float(self.estimator.state["time_s"][0])
        for i in range(seconds):
            self.estimator.step(time_s + 1.0 + i, 0.3, 3.8)
        self.now_s += seconds
        self.file.save(self.estimator.record)
        return self.estimator.record.copy()

    @property
    def is_whole(self) -> bool:
        """True if the whole file was written since the start."""
        return self.file.path.stat().st_ino != self.whole_inode

    def load(self) -> Any:
        """Return the content of the file, as the next run reads it."""
        return CheckpointFile(self.file.path.parent, SETTINGS, CELL, self.clock).load()


@pytest.fixture
def pack(tmp_path: Path) -> SavedPack:
    return SavedPack(tmp_path)


def test_small_changes_are_saved_in_one_block_and_restored_with_their_time(pack: SavedPack) -> None:
    first_covariance = pack.estimator.record["filter"]["covariance"].copy()
    pack.run(5)
    state = pack.run(5)
    assert not pack.is_whole
    sizes = [pack.file.path.with_suffix(suffix).stat().st_size for suffix in CHANGES_SUFFIXES]
    assert sizes == [BLOCK_BYTES, BLOCK_BYTES]
    pack.now_s += 7.0
    content = pack.load()
    assert content.gap_s == pytest.approx(7.0)
    count = state["filter"]["count"][0]
    assert content.record["observer.soc"] == state["observer"]["soc"]
    assert np.array_equal(content.record["filter.mean"][0, :count], state["filter"]["mean"][0, :count])
    assert np.array_equal(content.record["history.charge_as"], state["history"]["charge_as"])
    assert np.array_equal(content.record["filter.covariance"], first_covariance)
    assert restore_state(compiled_estimator(SETTINGS, CELL), content.record, content.gap_s) == ""


def test_a_block_damaged_by_a_power_failure_leaves_the_state_of_the_save_before(pack: SavedPack) -> None:
    before = pack.run(5)
    pack.run(5)
    newest = max((pack.file.path.with_suffix(s) for s in CHANGES_SUFFIXES), key=lambda path: path.stat().st_mtime_ns)
    newest.write_bytes(newest.read_bytes()[: BLOCK_BYTES // 2])
    assert pack.load().record["observer.soc"] == before["observer"]["soc"]


def test_changes_of_an_earlier_whole_file_are_ignored(pack: SavedPack) -> None:
    pack.run(5)
    state = learned_estimator().record
    CheckpointFile(pack.file.path.parent, SETTINGS, CELL, pack.clock).save(state)
    loaded = pack.load().record
    state["filter"][SCRATCH] = 0.0
    assert all(np.array_equal(loaded[name], value, equal_nan=True) for name, value in fields(state))


def _jump(pack: SavedPack) -> None:
    pack.estimator.state["soc"] -= MAX_SOC_CHANGE + 0.05


def _wait(pack: SavedPack) -> None:
    pack.now_s += MAX_BASE_AGE_S


def _merge(pack: SavedPack) -> None:
    pack.estimator.record["filter"]["count"] += 1


def _restart_hypotheses(pack: SavedPack) -> None:
    pack.estimator.record["filter"]["seeded_s"] = -100.0


def _widen(pack: SavedPack) -> None:
    pack.estimator.record["filter"]["soc_std"] *= 1.5


@pytest.mark.parametrize("change", [_jump, _wait, _merge, _restart_hypotheses, _widen])
def test_the_whole_file_is_saved_when_its_covariances_do_not_fit(
    pack: SavedPack, change: Callable[[SavedPack], None]
) -> None:
    pack.run(2)
    assert not pack.is_whole
    change(pack)
    pack.file.save(pack.estimator.record)
    assert pack.is_whole


def test_the_whole_file_is_saved_relative_to_new_curves_and_when_changes_cannot_be_written(pack: SavedPack) -> None:
    for suffix in CHANGES_SUFFIXES:
        pack.file.path.with_suffix(suffix).mkdir()
    pack.run(2)
    assert pack.is_whole
    pack.whole_inode = pack.file.path.stat().st_ino
    pack.file.save(pack.estimator.record, {"ocv_v": np.ones(3)})
    assert pack.is_whole
