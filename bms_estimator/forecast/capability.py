"""Present capability of a pack: available power, usable capacity, remaining energy, and time to full.

These values need no forecast of the load, and therefore exist at rest and during a charge, too.
"""

from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.forecast.forecast import ForecastRows
from bms_estimator.forecast.limiting_cells import charge_limiting_states, discharge_limiting_states
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, RESISTANCES
from bms_estimator.kernels.forecast.charge import charge_current, time_to_full
from bms_estimator.kernels.forecast.draws import DRAW
from bms_estimator.kernels.forecast.mean_discharge import charge_to_cutoff
from bms_estimator.kernels.forecast.power import available_power, new_scratch
from bms_estimator.kernels.forecast.projected_pack import PROJECTED_PACK, project_pack
from bms_estimator.model.arrays import Records
from bms_estimator.model.cell import CellModel
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings

QUANTILE_STDS = 1.645
"""Distance of the 5 % quantile of a normal distribution from its mean, in standard deviations."""
DURATIONS_S = 10.0, 60.0
"""Durations of the available power [s]."""


@dataclass(frozen=True)
class PowerLimits:
    """Limits of current and temperature that bound the available power.

    Attributes:
        discharge_a: Largest discharge current [A], above 0.
        charge_a: Largest charge current [A], above 0.
        charge_min_c: Temperature below which the pack must not be charged [C].
    """

    discharge_a: float
    charge_a: float
    charge_min_c: float = 0.0


def cell_power_limits(cell: PackModel) -> PowerLimits:
    """Return the limits of the cell file: ``current_max_a`` in both directions.

    Args:
        cell: Model of the whole pack.
    """
    return PowerLimits(cell.cell.current_max_a, cell.cell.current_max_a)


def power_limits(settings: Settings, cell: CellModel) -> PowerLimits:
    """Return the limits that the pack's alarms set. A current limit is never above the limit of the cell file.

    If the alarm on a current is switched off, the limit of the cell file applies. If the alarm on charging below freezing is
    switched off, no temperature limits the charge.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack.
    """
    alarms = {alarm.name: alarm.limit for alarm in monitored_alarms(settings, cell)}
    max_a = cell.cell.current_max_a
    return PowerLimits(
        min(alarms.get("discharge_over_current", max_a), max_a),
        min(alarms.get("charge_over_current", max_a), max_a),
        alarms.get("charging_below_freezing", -np.inf),
    )


def write_capability(
    values: ForecastRows,
    estimator: Estimator,
    cutoff_v: float,
    limits: PowerLimits,
    largest_a: float,
    cells: CellDeviations | None = None,
) -> None:
    """Write available power, usable capacity, remaining energy and time to full to ``values``.

    With ``cells``, the cell that first reaches its share of the voltage limit determines power and capacity.

    The values stay unchanged before the first sample, without the identifier and for a fuel cell.

    Args:
        values: Shape (1,), dtype ``FORECAST``; written.
        estimator: Estimator of the pack; read only.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        limits: Limits of current and temperature.
        largest_a: Largest current of the load since the last long charge [A].
        cells: Deviations of the single cells; None: unknown.
    """
    states, settings = estimator.record["filter"], estimator.settings_record[0]["filter"]
    state = states[0]
    if not state["started"]:
        return
    anchors = estimator.settings_record[0]["anchors"]
    full_v, tail_a = float(anchors["charger_v"]), float(anchors["tail_a"])
    charge_a = limits.charge_a if state["temperature_c"] >= limits.charge_min_c else 0.0
    scratch = new_scratch()
    states_by_name = {
        "discharge": [states, *discharge_limiting_states(states, cells)],
        "charge": [states, *charge_limiting_states(states, cells)],
    }
    for duration_s in DURATIONS_S:
        for name, limit_v, max_a in (("discharge", cutoff_v, limits.discharge_a), ("charge", full_v, -charge_a)):
            values[f"available_{name}_power_{duration_s:.0f}s_w"] = min(
                available_power(each[0], settings, duration_s, limit_v, max_a, QUANTILE_STDS, scratch)
                for each in states_by_name[name]
            )
    write_usable_charge(values, estimator, cutoff_v, largest_a, cells)
    present_a = charge_current(state, settings)
    if present_a < 0.0:
        values["time_to_full_s"] = time_to_full(
            state, settings, present_a, full_v, tail_a, np.empty(RESISTANCES + BRANCHES)
        )


def write_usable_charge(
    values: ForecastRows, estimator: Estimator, cutoff_v: float, largest_a: float, cells: CellDeviations | None = None
) -> None:
    """Write usable capacity and remaining energy to ``values``.

    Both stay unchanged before the first sample, without the identifier and for a fuel cell.

    Args:
        values: Shape (1,), dtype ``FORECAST``; written.
        estimator: Estimator of the pack; read only.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        largest_a: Largest current of the load [A]. The mean current of the last ten minutes applies if it is larger.
        cells: Deviations of the single cells; None: unknown.
    """
    state = estimator.record["filter"]
    if not state["started"][0]:
        return
    charge_as, energy_ws = usable_charge(state, estimator, cutoff_v, largest_a)
    limited_as = min(
        [
            charge_as,
            *(
                usable_charge(each, estimator, cutoff_v, largest_a)[0]
                for each in discharge_limiting_states(state, cells)
            ),
        ]
    )
    values["usable_capacity_ah"] = limited_as / 3600.0
    # the mean voltage is assumed not to depend on the limiting cell, so that the energy is proportional to the charge
    values["remaining_energy_wh"] = energy_ws / 3600.0 * (limited_as / charge_as if charge_as > 0.0 else 1.0)


def usable_charge(state: Records, estimator: Estimator, cutoff_v: float, largest_a: float) -> tuple[float, float]:
    """Return charge [A s] and energy at the terminals [W s] from a state of the filter to the cut-off.

    Args:
        state: Shape (1,), dtype EKF_STATE, of the pack or of a pack whose cells all equal one of its cells.
        estimator: Estimator of the pack; read only.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        largest_a: Largest current of the load [A].
    """
    settings, pack, draw = estimator.settings_record["filter"], np.zeros(1, PROJECTED_PACK), np.zeros(1, DRAW)
    return charge_to_cutoff(state, settings, cutoff_v, largest_a, pack, draw)


def projected_pack(estimator: Estimator, cutoff_v: float, largest_a: float) -> Records:
    """Return the present state of the pack, shape (1,), dtype ``PROJECTED_PACK``.

    Args:
        estimator: Estimator of the pack with a started identifier; read only.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        largest_a: Largest current of the expected load [A].
    """
    pack = np.zeros(1, PROJECTED_PACK)
    project_pack(pack[0], estimator.record[0]["filter"], estimator.settings_record[0]["filter"], cutoff_v, largest_a)
    return pack
