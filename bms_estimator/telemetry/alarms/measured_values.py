"""Values that alarms on measured quantities compare with their limits."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SampleBlock, SampleStatus
from bms_estimator.settings.alarms import AlarmName


def measured_values(samples: SampleBlock, cells: Floats, charging_a: float) -> dict[AlarmName, Floats]:
    """Return the values that the alarms compare with their limits, each of shape (n,).

    Args:
        samples: Shape (n,), dtype SAMPLE.
        cells: Minimum and maximum [V] of the cell voltages in the first two columns, shape (n, 4).
        charging_a: Minimum current into the pack that counts as charging [A].
    """
    lowest_v, highest_v = cells[:, 0], cells[:, 1]
    voltage_v = samples["voltage_v"]
    coldest_c, hottest_c = _extreme_temperatures(samples)
    # beyond the range of the converter, and therefore beyond every limit
    voltage_is_saturated = has_bit(samples, SampleStatus.VOLTAGE_SATURATED)
    current_a = np.where(
        has_bit(samples, SampleStatus.CURRENT_SATURATED),
        np.copysign(np.inf, samples["current_a"]),
        samples["current_a"],
    )
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


class WireLimits(NamedTuple):
    """Voltages that show a broken wire beside an alarm of the opposite side [V]."""

    low_v: float
    """Voltage of a pack with an over-voltage is not below this one."""
    low_cell_v: float
    """Voltage of the lowest cell beside one with an over-voltage is not below this one."""
    high_cell_v: float
    """Voltage of the highest cell beside one with an under-voltage is not above this one."""


def uncertain_values(
    samples: SampleBlock, cells: Floats, expected_cells: int, limits: WireLimits
) -> dict[AlarmName, NDArray[np.bool_]]:
    """Return where the true value of an alarm may be beyond its limit although the measured one is not, each of shape (n,).

    Heat destroys probes, a broken wire hides a voltage or lets it float to an end of the range, and a dead current sensor reads
    an end of its range.

    Args:
        samples: Shape (n,), dtype SAMPLE.
        cells: As for ``measured_values``, with the number of cell voltages in the third column.
        expected_cells: Largest number of cell voltages so far.
        limits: Voltages that show a broken wire.
    """
    has_probe_fault, is_saturated = (
        has_bit(samples, bit) for bit in (SampleStatus.PROBE_FAULT, SampleStatus.CURRENT_SATURATED)
    )
    lacks_cell = (cells[:, 2] > 0) & (cells[:, 2] < expected_cells)
    return {
        "pack_over_voltage": samples["voltage_v"] < limits.low_v,
        "pack_under_voltage": has_bit(samples, SampleStatus.VOLTAGE_SATURATED),
        "cell_over_voltage": lacks_cell | (cells[:, 0] < limits.low_cell_v),
        "cell_under_voltage": lacks_cell | (cells[:, 1] > limits.high_cell_v),
        "discharge_over_current": is_saturated,
        "charge_over_current": is_saturated,
        "over_temperature": has_probe_fault,
        "under_temperature": has_probe_fault,
        "charging_below_freezing": has_probe_fault & (samples["current_a"] < 0.0),
    }


def has_bit(samples: SampleBlock, bit: SampleStatus) -> NDArray[np.bool_]:
    """Return where a bit of the status is set, shape (n,)."""
    return np.asarray((samples["status"] & bit) != 0)


def _extreme_temperatures(samples: SampleBlock) -> tuple[Floats, Floats]:
    """Return the temperatures of the coldest and of the hottest probe [C], each of shape (n,).

    Samples of other programs may have only a mean temperature, or extremes that do not enclose it. The mean is then used.
    """
    mean_c, lowest_c, highest_c = (samples[f"temperature_{name}c"] for name in ("", "min_", "max_"))
    has_extremes = (lowest_c <= mean_c) & (mean_c <= highest_c)
    return np.where(has_extremes, lowest_c, mean_c), np.where(has_extremes, highest_c, mean_c)
