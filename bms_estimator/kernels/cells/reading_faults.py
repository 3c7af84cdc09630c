"""Faults of a cell's reading, which differ from faults of the cell: they appear as a jump of the innovation.

A fault of the cell changes its voltage slowly, because its SOC and its resistance change slowly.
``c`` is a record of CELL.
"""

import math

from bms_estimator.kernels.cells.cell_filter import MAX_RESISTANCE_STD
from bms_estimator.kernels.cells.records import LEAK, RESISTANCE, SOC, SUM_1, SUM_A, SUM_A2, SUM_AV, SUM_V, ReadingFault
from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit

GATE_V = 0.010
"""Minimum innovation that may be a fault of the reading [V]: ten steps of the usual converter."""
GATE_STD = 4.0
"""Minimum innovation that may be a fault of the reading, in std."""
JUMP_FRACTION = 0.5
"""Minimum size of a jump: deviation of the innovation from its mean over ``JUMP_S``, as a fraction of the innovation."""
JUMP_S = 120.0
"""Time constant of the mean innovation before a jump [s]. The voltage of a cell of 20 Ah with a short of 1 ohm drifts by
about 4 mV in this time, which is less than ``GATE_V``."""
MEMORY_S = 300.0
"""Time constant of the sums that attribute an error to the current or to an offset [s]."""
CONFIRMATION_S = 60.0
"""Duration after which a jump that persists is a fault [s]."""
RECOVERY_S = 60.0
"""Duration of correct readings after which a fault has ended [s]."""
CONTACT_STD = 4.0
"""Minimum significance of a contact's resistance, in std."""
CONTACT_FRACTION = 0.5
"""Minimum fraction of the squared error that a contact's resistance explains."""
STUCK_STEP_V = 2e-4
"""Minimum change of a window's mean voltage that counts as a change of the reading [V]."""
ALIVE_V = 0.002
"""Change of the other cells' voltage to which a correct reading responds [V]."""
STUCK_V = 0.03
"""A reading is stuck if it does not respond to this change of the other cells' voltage [V]."""
DRIFT_SOC_STD = 0.1
"""Std of a cell's SOC if its error drifts."""
DRIFT_LEAK_STD = 0.1
"""Std of the self-discharge of a cell whose error drifts [1/h]."""
OPPOSITE_TOLERANCE = 0.3
"""Maximum sum of two neighbors' errors, relative to the larger one, if they share a faulty sense wire."""
_NONE, _STUCK = int(ReadingFault.NONE), int(ReadingFault.STUCK)
_CONTACT, _OFFSET, _WIRE = int(ReadingFault.CONTACT), int(ReadingFault.OFFSET), int(ReadingFault.SENSE_WIRE)


@njit(cache=True)
def missed_change_v(c: Record, voltage_v: float, reference_v: float) -> float:
    """Return the change of the median voltage of the cells since the last change of this reading [V].

    Args:
        c: The cell; updated.
        voltage_v: Voltage of the cell [V].
        reference_v: Median voltage of the cells [V].
    """
    if not abs(voltage_v - c.held_v) <= STUCK_STEP_V:
        c.held_v, c.held_reference_v = voltage_v, reference_v
    return abs(reference_v - c.held_reference_v)


@njit(cache=True)
def is_jump(c: Record, innovation_v: float, variance_v2: float, curve_v: float) -> bool:
    """Return True if the innovation left its range within minutes.

    Args:
        c: The cell.
        innovation_v: Innovation [V].
        variance_v2: Variance S of the innovation [V^2].
        curve_v: Largest error due to the curvature of the OCV [V], which is large near full and empty.
    """
    is_large = abs(innovation_v) > max(GATE_V, GATE_STD * math.sqrt(variance_v2), curve_v)
    return is_large and abs(innovation_v - c.innovation_v) > JUMP_FRACTION * abs(innovation_v)


@njit(cache=True)
def examine_reading(
    c: Record, innovation_v: float, current_a: float, elapsed_s: float, noise_v2: float, alive: bool
) -> None:
    """Examine the reading of a cell after a jump: classify its fault, or end it after correct readings.

    Args:
        c: The cell; updated.
        innovation_v: Innovation [V]. The state has not been corrected since the jump.
        current_a: Mean current of the window [A].
        elapsed_s: Duration of the window [s].
        noise_v2: Variance of an innovation without the fault [V^2].
        alive: True if the reading responds to the load. A stuck reading is right by chance when the voltage passes it.
    """
    decay = math.exp(-elapsed_s / MEMORY_S)
    expected_v = c.offset_v + c.error_ohm * current_a
    contradicts = alive and abs(expected_v) > GATE_V and abs(innovation_v) < 0.5 * abs(expected_v)
    if contradicts:
        c.recovered_s += elapsed_s
        if c.recovered_s >= RECOVERY_S:
            end_fault(c)
        return
    if abs(expected_v) > GATE_V:
        c.recovered_s = 0.0
    s = c.sums
    for i in range(s.size):
        s[i] *= decay
    s[SUM_1] += 1.0
    s[SUM_A] += current_a
    s[SUM_A2] += current_a * current_a
    s[SUM_V] += innovation_v
    s[SUM_AV] += current_a * innovation_v
    c.suspect_s += elapsed_s
    spread_a2 = s[SUM_A2] - s[SUM_A] ** 2 / s[SUM_1]
    product = s[SUM_AV] - s[SUM_A] * s[SUM_V] / s[SUM_1]
    slope_ohm = product / spread_a2 if spread_a2 > 0.0 else 0.0
    is_significant = slope_ohm**2 * spread_a2 > CONTACT_STD**2 * noise_v2
    mean_v = s[SUM_V] / s[SUM_1]
    offset_v = mean_v - slope_ohm * s[SUM_A] / s[SUM_1]
    by_current_v2 = slope_ohm**2 * s[SUM_A2] / s[SUM_1]
    is_contact = is_significant and by_current_v2 > CONTACT_FRACTION * (by_current_v2 + offset_v**2)
    if is_contact and slope_ohm > 0.0:  # a contact whose resistance was learned has been repaired
        end_fault(c)
        c.covariance[RESISTANCE, RESISTANCE] = MAX_RESISTANCE_STD**2
        return
    c.error_ohm, c.offset_v = (slope_ohm, offset_v) if is_contact else (0.0, mean_v)
    if c.suspect_s >= CONFIRMATION_S:
        if is_contact or c.fault != _OFFSET:
            c.first_offset_v = mean_v
        if alive and not is_contact and abs(mean_v - c.first_offset_v) > max(GATE_V, 0.5 * abs(c.first_offset_v)):
            # the error drifts, as after a short, and unlike the offset of a reading
            end_fault(c)
            c.covariance[SOC, SOC] += DRIFT_SOC_STD**2
            c.covariance[LEAK, LEAK] = DRIFT_LEAK_STD**2
            return
        c.fault = _CONTACT if is_contact else _OFFSET
        c.error_v = max(abs(innovation_v), math.sqrt(by_current_v2) if is_contact else abs(mean_v))


@njit(cache=True)
def end_fault(c: Record) -> None:
    """End the fault of a reading."""
    c.fault = _NONE
    c.error_v = c.suspect_s = c.recovered_s = c.error_ohm = c.offset_v = 0.0
    for i in range(c.sums.size):
        c.sums[i] = 0.0


@njit(cache=True)
def mark_sense_wires(cells: Records) -> None:
    """Mark neighbors with opposite offsets. Their sum is right, because only the tap between them is wrong."""
    for i in range(cells.size - 1):
        first, second = cells[i], cells[i + 1]
        # an offset, or a wire that is marked already
        if first.fault >= _OFFSET and second.fault >= _OFFSET:
            larger_v = max(abs(first.offset_v), abs(second.offset_v))
            if abs(first.offset_v + second.offset_v) < OPPOSITE_TOLERANCE * larger_v:
                first.fault = second.fault = _WIRE
