"""Continuation of a history after a restart of the service.

A checkpoint is saved each minute, and the history each hour. The checkpoint's record of the history is therefore newer than
the saved rows, or, after a crash between both writes, older.
"""

import math

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.pack_model.history import History


def resume_history(estimator: Estimator, history: History, gap_s: float, capacity_as: float, *, restored: bool) -> None:
    """Append the checkpoint's rows that are not in the saved history, and begin a segment with an unused number.

    Args:
        estimator: Estimator of the pack, restored from a checkpoint, or new.
        history: Saved rows.
        gap_s: Time since the checkpoint was saved [s]; infinite if unknown.
        capacity_as: Declared capacity [A s].
        restored: True if the estimator is restored.
    """
    if not restored and not history.rows.size:
        return  # the first start
    is_linked = restored and _append_saved(estimator, history, capacity_as)
    rows = history.rows
    elapsed_s, segment = (rows["elapsed_s"][-1], rows["segment"][-1]) if rows.size else (0.0, 0.0)
    estimator.begin_segment(elapsed_s, segment, gap_s if is_linked else math.inf)


def _append_saved(estimator: Estimator, history: History, capacity_as: float) -> bool:
    """Append the checkpoint's rows that are not in the saved history, and a row with its counted charge.

    Return True if the charge was counted without interruption up to the checkpoint.
    """
    rows, h = estimator.complete_rows(), estimator.record[0]["history"]
    if history.rows.size:
        last = history.rows[-1]
        if last["segment"] > h["segment"]:
            return False
        rows = rows[rows["elapsed_s"] > last["elapsed_s"]]
        # if the first of these rows belongs to a later segment than the last saved row, rows between them may be lost, and the
        # charge between both segments is unknown
        rows["gap_s"][(rows["segment"] > last["segment"]) & (rows["segment"] == rows["segment"][:1])] = math.inf
    elif not rows.size:
        return False
    history.append(rows, capacity_as)
    history.append(_row_at_checkpoint(h, estimator.record[0]["filter"], history.rows[-1]), capacity_as)
    return True


def _row_at_checkpoint(h: np.void, filter_state: np.void, last: np.void) -> np.ndarray:
    """Return a row without a voltage, with the charge up to the checkpoint.

    The next segment is linked to it. ``last`` is the last saved row.
    """
    row = np.zeros(1, HISTORY_ROW)
    row["elapsed_s"] = max(h["elapsed_s"], last["elapsed_s"])
    row["segment"] = h["segment"]
    row["gap_s"] = last["gap_s"] if last["segment"] == h["segment"] else math.inf
    for name in ("charge_as", "charge_variance_as2", "throughput_soc", "hysteresis"):
        row[name] = h[name]
    row["temperature_c"], row["soc"] = filter_state["temperature_c"], filter_state["soc"]
    row["reference_soc"] = row["reference_std"] = math.nan
    return row
