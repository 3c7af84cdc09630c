"""Part of the topic ``health`` about the fit of the pack's model."""

from typing import NamedTuple

import numpy as np

from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.pack_model import FitReport, PackModelHealth
from bms_estimator.pack_model.history import DAY_S
from bms_estimator.pack_model.learning import SlowFit


class FitTimes(NamedTuple):
    """End of the last fit [s since 1970] and its duration [s]; None before the first."""

    finished_s: float | None
    duration_s: float | None


NO_FIT = FitTimes(None, None)


def pack_model_health(model: SlowFit, times: FitTimes) -> PackModelHealth:
    """Return the state of the slow fit.

    Args:
        model: Slow fit; read only.
        times: End and duration of the last fit.
    """
    estimator, rows = model.estimator, model.history.rows
    declared_ah = float(estimator.settings["capacity_as"][0]) / 3600.0
    capacity = relative_capacity(estimator.record[0]) if estimator.state["started"][0] else None
    return PackModelHealth(
        fits=model.fits,
        late=model.late,
        failed=model.failed,
        changes=model.changes,
        rows=rows.size,
        segments=1 + int(np.count_nonzero(np.diff(rows["segment"]))) if rows.size else 0,
        history_days=float(np.ptp(rows["elapsed_s"])) / DAY_S if rows.size else 0.0,
        capacity_ah=capacity.value * declared_ah if capacity else None,
        capacity_std_ah=capacity.std * declared_ah if capacity else None,
        last_fit=None if times.finished_s is None else iso_utc(times.finished_s),
        last_fit_s=times.duration_s,
        change=last_change(model),
    )


def last_change(model: SlowFit) -> FitReport | None:
    """Return the last change of SOC and capacity by a fit; None: none since start."""
    change, declared_ah = model.last_change, float(model.estimator.settings["capacity_as"][0]) / 3600.0
    if change is None:
        return None
    return FitReport(
        soc_before=change.soc_before,
        soc_after=change.soc_after,
        capacity_before_ah=change.capacity_before * declared_ah,
        capacity_after_ah=change.capacity_after * declared_ah,
    )
