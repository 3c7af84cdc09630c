"""Values of the alarms on measured quantities and on estimates, and reasons why such a value is not known."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.accumulators.soc_certainty import MIN_UNKNOWN_STD
from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SampleBlock, SampleStatus
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.stability_margin import applicable_margin

SOC_ALARMS: tuple[AlarmName, ...] = ("soc_low", "stability_margin_low")
"""Alarms that need a known SOC. The probability of ``collapse_risk`` includes the uncertainty of the SOC."""
UNKNOWN_SOC = f"the SOC is not known yet: it is known once its standard deviation has fallen below {100.0 * MIN_UNKNOWN_STD:.0f} %"
"""Reason of ``SOC_ALARMS``."""
NO_MARGIN = "the margin does not apply: the cell model is stable at each SOC"
"""Reason of ``stability_margin_low`` with a known SOC."""


def measured_values(samples: SampleBlock, cells: Floats, charging_a: float) -> dict[AlarmName, Floats]:
    """Return the values of the alarms on measured quantities, each of shape (n,).

    Args:
        samples: Shape (n,), dtype SAMPLE.
        cells: Minimum and maximum [V] of the cell voltages in the first two columns, shape (n, 4).
        charging_a: Minimum current into the pack that counts as charging [A].
    """
    lowest_v, highest_v = cells[:, 0], cells[:, 1]
    voltage_v = samples["voltage_v"]
    coldest_c, hottest_c = _extreme_temperatures(samples)
    is_saturated = (samples["status"] & SampleStatus.CURRENT_SATURATED) != 0
    current_a = np.where(is_saturated, np.copysign(np.inf, samples["current_a"]), samples["current_a"])
    # the lowest temperature while charging; infinite while not charging, NaN if a quantity is not measured
    charging_c = np.where(current_a <= -charging_a, coldest_c, np.inf)
    charging_c[np.isnan(current_a) | np.isnan(coldest_c)] = np.nan
    return {
        "pack_over_voltage": voltage_v,
        "pack_under_voltage": voltage_v,
        "cell_over_voltage": highest_v,
        "cell_under_voltage": lowest_v,
        "cell_imbalance": highest_v - lowest_v,
        "discharge_over_current": current_a,
        "charge_over_current": -current_a,
        "over_temperature": hottest_c,
        "under_temperature": coldest_c,
        "charging_below_freezing": charging_c,
    }


def _extreme_temperatures(samples: SampleBlock) -> tuple[Floats, Floats]:
    """Return the temperatures of the coldest and of the hottest probe [C], each of shape (n,).

    Samples of other programs may have only a mean temperature, and extremes that do not enclose it. The mean is then used.
    """
    mean_c, lowest_c, highest_c = (samples[f"temperature_{name}c"] for name in ("", "min_", "max_"))
    has_extremes = (lowest_c <= mean_c) & (mean_c <= highest_c)
    return np.where(has_extremes, lowest_c, mean_c), np.where(has_extremes, highest_c, mean_c)


def estimated_values(
    trace: TraceBlock, is_mismatch: NDArray[np.bool_], soc_known: NDArray[np.bool_]
) -> dict[AlarmName, Floats]:
    """Return the values of the alarms on estimates, each of shape (n,). Values that need an unknown SOC are NaN.

    Args:
        trace: Shape (n,), dtype TRACE.
        is_mismatch: True where the filter suspects a wrong cell model, or the observer is out of lock; shape (n,).
        soc_known: True where the SOC is known, shape (n,).
    """
    std = trace["soc_std"]
    return {
        "soc_low": np.where(soc_known, trace["soc"] - np.where(np.isnan(std), 0.0, std), np.nan),
        "stability_margin_low": applicable_margin(trace, soc_known),
        "model_mismatch": np.where(is_mismatch, np.inf, np.abs(trace["innovation_v"])),
    }


def find_unknown(row: np.void, *, soc_known: bool) -> dict[AlarmName, str]:
    """Return the alarms whose value is not known although the quantities that they need are measured, each with the reason.

    A fuel cell has no such alarm, because it has no SOC.

    Args:
        row: The last estimate, dtype TRACE.
        soc_known: True if its SOC is known.
    """
    if math.isnan(row["soc"]):
        return {}
    if not soc_known:
        return dict.fromkeys(SOC_ALARMS, UNKNOWN_SOC)
    return {"stability_margin_low": NO_MARGIN} if np.isnan(applicable_margin(row, soc_known)) else {}
