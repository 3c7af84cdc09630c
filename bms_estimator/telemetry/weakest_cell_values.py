"""Published values of the weakest cell of a bank without cell voltages."""

import math
from typing import NamedTuple

from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.pack_model.learning import SlowFit
from bms_estimator.telemetry.state import finite


class WeakestCellValues(NamedTuple):
    """Values of the weakest cell; NaN if unknown."""

    weakest_cell_soc: float = math.nan
    """SOC, 0..1."""
    weakest_cell_soc_std: float = math.nan
    """Std of this SOC."""
    weakest_cell_capacity: float = math.nan
    """Capacity relative to the other cells."""
    usable_capacity_to_weakest_ah: float = math.nan
    """Charge until the weakest cell is empty [Ah]."""
    deviation_std: float = math.nan
    """Deviation of the last discharge from the reference [std]."""


UNKNOWN = WeakestCellValues()
"""Values before the first comparison, and of a pack without a slow fit."""


def weakest_cell_values(model: SlowFit | None) -> WeakestCellValues:
    """Return the values of the weakest cell, from the last comparison and the filter's present SOC.

    Args:
        model: Slow fit of the bank, which is not changed; None for a pack without a slow fit.
    """
    if model is None or model.bank is None or model.bank.weakest is None or math.isnan(model.estimator.soc):
        return UNKNOWN
    weakest, estimator = model.bank.weakest, model.estimator
    soc, std = weakest.weakest_soc(estimator.soc)
    filter_std = float(estimator.record[0]["filter"]["soc_std"])
    capacity_ah = relative_capacity(estimator.record[0]).value * float(estimator.settings["capacity_as"][0]) / 3600.0
    usable_soc = max(weakest.others_soc(estimator.soc) - weakest.empty_soc, 0.0)
    return WeakestCellValues(
        soc, math.hypot(std, filter_std), weakest.capacity_ratio, usable_soc * capacity_ah, weakest.deviation_std
    )


def bank_fields(values: WeakestCellValues) -> dict[str, float | int | None]:
    """Return the fields of ``Estimate`` that describe the weakest cell of a bank without cell voltages."""
    fields = values._asdict()
    del fields["deviation_std"]  # only the alarm uses it
    return {name: finite(value) for name, value in fields.items()}
