"""Simulation of draws under a load that the caller gives as parts with a constant current or power."""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, TAUS
from bms_estimator.kernels.forecast.projected_pack import grid_position, voltage_without_load
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.numba_cache import njit

LOAD_PART = np.dtype(
    [
        ("duration_s", "f8"),
        ("current_a", "f8"),  # current [A]; NaN: ``power_w`` applies
        ("power_w", "f8"),  # power [W]; ignored if there is a current
        ("decay", "f8", BRANCHES),  # decay factor of each RC pair over the duration
    ],
    align=True,
)
"""Part of the given load."""


@njit(cache=True)
def set_decays(parts: Records) -> None:
    """Write the decays of the RC pairs over each part."""
    for n in range(parts.shape[0]):
        for k in range(BRANCHES):
            parts[n].decay[k] = math.exp(-parts[n].duration_s / TAUS[k])


@njit(cache=True, nogil=True)  # a request for a forecast runs in a thread, while the event loop reads samples
def simulate_given_load(
    m: Record, parts: Records, horizon_s: float, draws: Records, curve_step_s: float, soc: Floats, voltage_v: Floats
) -> None:
    """Simulate each draw until the cut-off or the horizon, and write its curves.

    Args:
        m: Record of PROJECTED_PACK.
        parts: Shape (n,), dtype LOAD_PART; the load repeats after its last part.
        horizon_s: Maximum time of a draw [s].
        draws: Shape (draws,), dtype DRAW, by ``draw_packs``; the outcomes are written.
        curve_step_s: Time between two points of the curves [s].
        soc: SOC of each draw, shape (draws, points); written.
        voltage_v: Terminal voltage of each draw [V]; written.
    """
    for n in range(draws.shape[0]):
        simulate_draw(m, parts, horizon_s, draws[n], curve_step_s, soc[n], voltage_v[n])


@njit(cache=True)
def simulate_draw(
    m: Record,
    parts: Records,
    horizon_s: float,
    d: Record,
    curve_step_s: float,
    soc_points: Floats,
    voltage_points_v: Floats,
) -> None:
    """Simulate one draw until the cut-off or the horizon.

    After the cut-off, the points of its curve have the SOC at the cut-off and the cut-off voltage.
    """
    x_a, ohm, index, point = m.x_a.copy(), np.empty(BRANCHES), 0, 0
    soc, elapsed_s, d.ended = d.begin_soc, 0.0, 0
    while elapsed_s < horizon_s:
        part = parts[index]
        i, t = grid_position(soc)
        factor = d.resistance_factor
        total_ohm = m.ohm[0, i] + t * (m.ohm[0, i + 1] - m.ohm[0, i])
        source_v = voltage_without_load(m, soc) + m.bias_v + d.voltage_error_v
        for k in range(BRANCHES):
            ohm[k] = m.ohm[1 + k, i] + t * (m.ohm[1 + k, i + 1] - m.ohm[1 + k, i])
            total_ohm += ohm[k] * (1.0 - part.decay[k])
            source_v -= factor * ohm[k] * x_a[k] * part.decay[k]
        current_a = part_current(part, source_v, factor * total_ohm)
        voltage_v = source_v - factor * total_ohm * current_a
        if not voltage_v > m.cutoff_v:  # also if the pack cannot supply the power
            d.ended = 1
            break
        while point < soc_points.size and point * curve_step_s < elapsed_s + part.duration_s:
            soc_points[point], voltage_points_v[point] = soc, voltage_v
            point += 1
        for k in range(BRANCHES):
            x_a[k] = current_a + (x_a[k] - current_a) * part.decay[k]
        soc = min(soc - current_a * part.duration_s / d.capacity_as, 1.0)
        elapsed_s += part.duration_s
        index = (index + 1) % parts.shape[0]
    d.time_s, d.soc = elapsed_s, soc
    for later in range(point, soc_points.size):
        soc_points[later], voltage_points_v[later] = soc, m.cutoff_v


@njit(cache=True)
def part_current(part: Record, source_v: float, ohm: float) -> float:
    """Return the current i of a part [A]. The terminal voltage at its end is ``source_v`` - ``ohm`` i.

    The current is infinite if the pack cannot supply the power.
    """
    if not math.isnan(part.current_a):
        return part.current_a
    discriminant_v2 = source_v * source_v - 4.0 * ohm * part.power_w
    if source_v <= 0.0 or discriminant_v2 < 0.0:
        return math.inf
    return 2.0 * part.power_w / (source_v + math.sqrt(discriminant_v2))
