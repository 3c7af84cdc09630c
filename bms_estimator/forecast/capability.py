"""Present capability of a pack: available power, usable capacity, remaining energy, and time to full.

These values need no forecast of the load, and therefore exist at rest and during a charge, too. In a pack with cell voltages,
single cells limit them. A cell's voltage limit is the pack's limit divided by the number of cells in series. A pack whose
cells all equal one cell reaches its limit when this cell does.
"""

import math

import numpy as np

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.available_power import DURATIONS_S, ForecastRows, PowerLimits, known_power_w
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, RESISTANCES
from bms_estimator.kernels.forecast.charge import charge_current, time_to_full
from bms_estimator.kernels.forecast.draws import DRAW
from bms_estimator.kernels.forecast.mean_discharge import charge_to_cutoff
from bms_estimator.kernels.forecast.projected_pack import PROJECTED_PACK, project_pack
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, LN_R0, SOC
from bms_estimator.model.arrays import Records


def discharge_limiting_states(state: Records, cells: CellDeviations | None) -> list[Records]:
    """Return states of packs whose cells all equal one of the cells that may limit a discharge.

    These are the cell with the least charge and the cell with the largest resistance.
    """
    if cells is None:
        return []
    least_charge, largest_r = np.argmin(cells.soc * cells.capacity_ratio), np.argmax(cells.resistance_ratio)
    return [state_of_cell(state, cells, i) for i in {int(least_charge), int(largest_r)}]


def charge_limiting_states(state: Records, cells: CellDeviations | None) -> list[Records]:
    """Return states of packs whose cells all equal one of the cells that may limit a charge.

    These are the cell with the highest SOC and the cell with the largest resistance.
    """
    if cells is None:
        return []
    return [state_of_cell(state, cells, i) for i in {int(np.argmax(cells.soc)), int(np.argmax(cells.resistance_ratio))}]


def state_of_cell(state: Records, cells: CellDeviations, i: int) -> Records:
    """Return the filter's state of a pack whose cells all have SOC, resistance and capacity of cell ``i``, from 0.

    Args:
        state: Shape (1,), dtype EKF_STATE, of the pack; read only.
        cells: Deviations of the single cells.
        i: Index of the cell.
    """
    shifted = state.copy()
    mean, covariance = shifted["mean"][0], shifted["covariance"][0]
    mean[:, SOC] += cells.soc_deviation[i]
    covariance[:, SOC, SOC] += cells.soc_deviation_std[i] ** 2
    mean[:, [LN_R0, LN_R]] += math.log(cells.resistance_ratio[i])
    mean[:, LN_Q] += math.log(cells.capacity_ratio[i])
    return shifted


def write_capability(
    values: ForecastRows,
    estimator: Estimator,
    cutoff_v: float,
    limits: PowerLimits,
    largest_a: float,
    cells: CellDeviations | None = None,
) -> None:
    """Write available power, usable capacity, remaining energy and time to full to ``values``.

    With ``cells``, the cell that first reaches its voltage limit determines power and capacity.

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
    charge_a = limits.charge_limit_a(float(state["temperature_c"]))
    discharging = [states, *discharge_limiting_states(states, cells)]
    charging = [states, *charge_limiting_states(states, cells)]
    for duration_s in DURATIONS_S:
        for name, each, limit_v, max_a in (
            ("discharge", discharging, cutoff_v, limits.discharge_a),
            ("charge", charging, full_v, -charge_a),
        ):
            values[f"available_{name}_power_{duration_s:.0f}s_w"] = known_power_w(
                each, settings, duration_s, limit_v, max_a
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
