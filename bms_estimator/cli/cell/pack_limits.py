"""Limits of a pack in a guided test, from its settings and alarms."""

import math

from bms_estimator.calibration.guided_test.plan import Limits
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.forecast.available_power import power_limits
from bms_estimator.model.cell import CellModel
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings

CUTOFF_MARGIN_V = 0.02
"""Distance of the default cut-off above the alarm for low voltage, per cell [V]."""
DEFAULT_TAIL_C_RATE = 0.05
"""Charge current at which a charge ends by default, as a C-rate [1/h]."""
DEFAULT_MAX_TEMPERATURE_C = 60.0
"""Maximum temperature of a pack without an alarm for high temperature [°C]. Most cells may be discharged up to it."""


def pack_limits(settings: Settings, pack: CellModel) -> Limits:
    """Return the limits of a pack, none of them beyond its alarms.

    Args:
        settings: Settings of the pack.
        pack: Model of the whole pack.
    """
    cells, charge = pack.cell.series_count, settings.pack.charge_limits
    alarms = {alarm.name: alarm.limit for alarm in monitored_alarms(settings, pack)}
    grid_v = ocv_grid(pack)[0]
    margin_v = CUTOFF_MARGIN_V * cells
    lowest_v = alarms["pack_under_voltage"] + margin_v if "pack_under_voltage" in alarms else float(grid_v[0])
    full_v = min(charge.full_voltage_v or float(grid_v[-1]), alarms.get("pack_over_voltage", math.inf))
    cutoff_v = max(charge.cutoff_voltage_v or 0.0, lowest_v)
    return Limits(
        capacity_ah=pack.cell.capacity_ah,
        series_count=cells,
        full_v=full_v,
        tail_a=charge.tail_current_a or DEFAULT_TAIL_C_RATE * pack.cell.capacity_ah,
        cutoff_v=cutoff_v,
        min_cell_v=alarms.get("cell_under_voltage", cutoff_v / cells - CUTOFF_MARGIN_V) + CUTOFF_MARGIN_V,
        max_cell_v=alarms.get("cell_over_voltage", full_v / cells + CUTOFF_MARGIN_V),
        max_discharge_a=power_limits(settings, pack).discharge_a,
        max_temperature_c=alarms.get("over_temperature", DEFAULT_MAX_TEMPERATURE_C),
    )
