"""Values of the alarms on measured quantities."""

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SampleBlock, SampleStatus
from bms_estimator.settings.alarms import AlarmName


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
    # beyond the range of the converter, and therefore beyond every limit
    voltage_is_saturated, current_is_saturated = (
        (samples["status"] & bit) != 0 for bit in (SampleStatus.VOLTAGE_SATURATED, SampleStatus.CURRENT_SATURATED)
    )
    current_a = np.where(current_is_saturated, np.copysign(np.inf, samples["current_a"]), samples["current_a"])
    # the lowest temperature while charging; infinite while not charging, NaN if a quantity is not measured
    charging_c = np.where(current_a <= -charging_a, coldest_c, np.inf)
    charging_c[np.isnan(current_a) | np.isnan(coldest_c)] = np.nan
    return {
        "pack_over_voltage": np.where(voltage_is_saturated, np.inf, voltage_v),
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
