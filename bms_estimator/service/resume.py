"""From a checkpoint's fields to an estimator that goes on from them."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.estimator_state import ESTIMATOR_STATE
from bms_estimator.kernels.identifier_state import (
    CURRENT_OFFSET,
    IDENTIFIER_COUNTERS,
    IDENTIFIER_STATE,
    LN_CAPACITY,
    SOC,
)
from bms_estimator.kernels.state import OBSERVER_STATE
from bms_estimator.service.checkpoint import fields

_DROPPED = tuple(name for name in OBSERVER_STATE.names or () if name.startswith("dropped_"))
COUNTERS = ("samples", "gaps", "time_steps_back", "lock_losses", "gain_rearms", *_DROPPED)
"""Fields of the observer's state that count since start."""
_SEEN = tuple(name for name in IDENTIFIER_STATE.names or () if name.startswith("seen_"))
SAME_SOC = 0.03
"""The identifier's SOC may leave 0..1 by as much; where it is further from the observer's, it was switched off."""


def resume(estimator: Estimator, saved: Mapping[str, NDArray[Any]], unseen_s: float) -> str:
    """Go on from a checkpoint's state, saved ``unseen_s`` ago, on the board's new clock. The counters count from this start.

    A field that the checkpoint does not have, or has in another shape, is what a first sample makes it; one that only the
    checkpoint has is left.

    Args:
        estimator: A new one; as it was when the state cannot be used.
        saved: Fields by their names.
        unseen_s: How long nobody measured [s]; infinite when nobody knows.

    Returns:
        Why the state cannot be used; empty when it is.
    """
    new = estimator.record.copy()
    estimator.step(0.0, 0.0, estimator.cell.cell.nominal_voltage_v)
    was_on = bool(np.any(saved.get("identifier.covariance", 0.0)))
    _fill(estimator.record, {name: v for name, v in saved.items() if was_on or not name.startswith("identifier.")})
    wrong = _insane(estimator)
    if wrong:
        estimator.record[...] = new
        return wrong
    x = estimator.record[0]["identifier"]
    if not was_on or abs(x["mean"][SOC] - estimator.state["soc"][0]) > SAME_SOC:
        unseen_s = math.inf
    _open_new_states(estimator)
    estimator.resume(unseen_s)
    for name in COUNTERS:
        estimator.state[name] = 0
    for name in (*IDENTIFIER_COUNTERS, *_SEEN):
        x[name] = 0
    return ""


def _fill(record: NDArray[np.void], saved: Mapping[str, NDArray[Any]]) -> None:
    for name, field in fields(record):
        known = saved.get(name)
        if known is not None and known.shape == field.shape:
            field[...] = known


def _open_new_states(estimator: Estimator) -> None:
    """Offset and capacity begin as configured where they were no states of the identifier before, or are none now."""
    x, p = estimator.record[0]["identifier"], estimator.settings_record[0]["identifier"]
    for j in (CURRENT_OFFSET, LN_CAPACITY):
        if (x["covariance"][j, j] > 0.0) != (p["variance"][j] > 0.0):
            x["mean"][j] = p["mean"][j]
            x["covariance"][j, :] = x["covariance"][:, j] = 0.0
            x["covariance"][j, j] = p["variance"][j]


def _insane(estimator: Estimator) -> str:
    """Why a state cannot be used; empty when it can."""
    record, cell = estimator.record, estimator.cell.cell
    for part in ("observer", "identifier", "map"):
        for name in ESTIMATOR_STATE[part].names or ():
            if not np.isfinite(record[part][name]).all():
                return f"{name} of the {part} is not finite"
    s = record[0]["observer"]
    if not s["started"]:
        return "no sample was taken"
    ranges = {
        "soc": (0.0, 1.0),
        "v_ts": (-cell.voltage_max_v, cell.voltage_max_v),
        "v_tl": (-cell.voltage_max_v, cell.voltage_max_v),
        "k": (0.0, np.inf),
    }
    for name, (low, high) in ranges.items():
        if not low <= s[name] <= high:
            return f"{name} = {s[name]} is outside {low}..{high}"
    variances = np.diagonal(record[0]["identifier"]["covariance"])
    for name, good in (("a parameter a1..a15", s["a"][1:16] > 0.0), ("a variance", variances >= 0.0)):
        if not good.all():
            return f"{name} is not positive"
    return ""
