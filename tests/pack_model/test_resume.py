"""Continuation of a history after a restart: charge that is in the checkpoint only, and numbers of segments."""

import math

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.resume import resume_history
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.pack import Settings

CELL = load_cell("ncr18650")
CAPACITY_AS = CELL.cell.capacity_ah * 3600.0


def discharged(seconds: int, saved_s: int) -> tuple[Estimator, History]:
    """Return an estimator after a discharge at C/2, and its history as it was saved at ``saved_s``."""
    estimator = compiled_estimator(Settings(), CELL)
    model, saved = SlowFit(estimator), History()
    for second in range(seconds):
        estimator.step(float(second), 0.5 * CELL.cell.capacity_ah, 3.9 + 1e-3 * (second % 3))
        if estimator.record["history"]["count"][0] >= 3 or second == saved_s:
            model.take_rows()
        if second == saved_s:
            saved = History(model.history.rows)
    return estimator, saved


def resumed(estimator: Estimator, saved: History, gap_s: float = 30.0) -> np.void:
    """Continue the saved history, and return the record of the history."""
    h: np.void = estimator.record[0]["history"]
    resume_history(estimator, saved, gap_s, CAPACITY_AS, restored=True)
    return h


def test_charge_since_the_last_saved_row_is_counted() -> None:
    estimator, saved = discharged(3000, saved_s=1000)
    last_as = saved.rows["charge_as"][-1]
    assert last_as < 1000 * CAPACITY_AS / 7200
    h = resumed(estimator, saved)
    assert saved.rows["charge_as"][-1] == pytest.approx(3000 * CAPACITY_AS / 7200, rel=1e-3)
    assert (np.diff(saved.rows["elapsed_s"]) >= 0.0).all()
    assert saved.rows["segment"][-1] == saved.rows["segment"][0]
    assert (h["segment"], h["gap_s"], h["charge_as"]) == (saved.rows["segment"][-1] + 1, 30.0, 0.0)


def test_a_history_newer_than_the_checkpoint_is_not_repeated() -> None:
    """The history was saved after the checkpoint, for example before a crash."""
    _, saved = discharged(3000, saved_s=2900)
    older, _ = discharged(1500, saved_s=0)
    rows = saved.rows.copy()
    h = resumed(older, saved)
    assert saved.rows[:-1].tobytes() == rows.tobytes()
    assert saved.rows["charge_as"][-1] == pytest.approx(1500 * CAPACITY_AS / 7200, rel=1e-3)
    assert h["elapsed_s"] >= rows["elapsed_s"][-1]


def test_a_number_of_a_segment_is_never_used_again() -> None:
    _, saved = discharged(3000, saved_s=2900)
    saved.rows["segment"] = 7.0  # begun after the checkpoint
    older, _ = discharged(1500, saved_s=0)
    h = resumed(older, saved)
    assert h["segment"] == 8
    assert math.isinf(h["gap_s"])


def test_lost_segments_make_the_charge_unknown() -> None:
    """Rows between the last saved one and a later segment were lost in a crash."""
    estimator, saved = discharged(3000, saved_s=1000)
    h = estimator.record[0]["history"]
    h["segment"], h["count"] = h["segment"] + 2, 0
    resumed(estimator, saved)
    new = saved.rows[saved.rows["segment"] > saved.rows["segment"][0]]
    assert new.size >= 1
    assert np.isinf(new["gap_s"]).all()
