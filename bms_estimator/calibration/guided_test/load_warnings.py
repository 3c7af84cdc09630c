"""Warnings about the current of a guided test, and about the limits of the pack."""

from bms_estimator.calibration.guided_test.averages import Average
from bms_estimator.calibration.guided_test.plan import Limits

MIN_LOAD_C_RATE = 0.1
"""Minimum C-rate of a load that determines resistances [1/h]."""


def load_warning(now: Average, limits: Limits) -> str:
    """Return a warning about the current of a discharge; empty if the current is suitable."""
    if now.current_a < -limits.rest_a:
        return f"The pack is charged at {-now.current_a:.2f} A: disconnect the charger, and connect a load."
    if now.current_a <= limits.rest_a:
        return "No current flows: connect the load."
    if now.current_a < MIN_LOAD_C_RATE * limits.capacity_ah:
        return f"The load draws only {now.current_a:.2f} A, too little to measure resistances."
    return ""


def limit_warning(now: Average, limits: Limits) -> str:
    """Return a warning about a limit of the pack that is exceeded; empty if no limit is."""
    if now.current_a > limits.max_discharge_a:
        return f"The load draws {now.current_a:.2f} A, more than {limits.max_discharge_a:.2f} A: reduce it now."
    if now.temperature_c > limits.max_temperature_c:
        return f"The pack is at {now.temperature_c:.0f} °C: disconnect charger and load until it is below {limits.max_temperature_c:.0f} °C."
    if now.current_a < -limits.rest_a and (
        now.max_cell_v > limits.max_cell_v or now.voltage_v > limits.max_cell_v * limits.series_count
    ):
        return "The voltage is above the limit of the cells: end the charge now."
    return ""


def empty_warning(now: Average, limits: Limits) -> str:
    """Return a warning about a load that discharges an empty pack; empty without one."""
    if now.current_a > limits.rest_a and now.voltage_v <= limits.cutoff_v:
        return f"The pack is empty ({now.voltage_v:.2f} V): remove the load now."
    return ""
