"""Voltage at which the load of a pack is switched off."""

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings


def load_cutoff_v(settings: Settings, cell: CellModel) -> float:
    """Return the terminal voltage at which the load is switched off and the forecast ends [V].

    It is the first configured value of ``pack.cutoff_v``, ``pack.cutoff_voltage_v``, the limit of the alarm
    ``pack_under_voltage``; otherwise the OCV at SOC 0.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack (``CellModel.pack``).

    Raises:
        UserError: ``pack.cutoff_v`` is not below the voltage of the full pack.
    """
    pack, ocv_v = settings.pack, ocv_grid(cell)[0]
    if pack.cutoff_v is not None:
        full_v = float(ocv_v[-1]) if pack.full_voltage_v is None else pack.full_voltage_v
        if pack.cutoff_v >= full_v:
            message = f"must be below {full_v:.4g} V, the voltage of the full pack"
            raise UserError(f"pack.cutoff_v = {pack.cutoff_v:g}: {message}")
        return pack.cutoff_v
    if pack.cutoff_voltage_v is not None:
        return pack.cutoff_voltage_v
    limits_v = (alarm.limit for alarm in monitored_alarms(settings, cell) if alarm.name == "pack_under_voltage")
    return next(limits_v, float(ocv_v[0]))
