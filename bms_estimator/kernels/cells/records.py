"""Records of the estimators of single cells.

Order of the state vector and of the covariance of one cell:

===  ===============  ==================================================================================
 0   SOC              SOC of the cell less that of the reference cell
 1   CAPACITY         capacity of the reference cell over that of the cell, minus 1
 2   RESISTANCE       resistance of the cell over that of the reference cell, minus 1
 3   LEAK             self-discharge current less that of the reference cell, as a C-rate [1/h]
 4   BIAS             error of the cell's voltage: offset of the reading, and deviation of its OCV curve [V]
===  ===============  ==================================================================================

The reference cell is the cell that the filter of the pack estimates.
"""

from enum import IntEnum

import numpy as np

SOC, CAPACITY, RESISTANCE, LEAK, BIAS = range(5)
"""Indices in the state vector."""
STATES = 5
"""Number of states of a cell."""
SUM_1, SUM_A, SUM_A2, SUM_V, SUM_AV = range(5)
"""Indices in ``sums``: weight, current, squared current, innovation, current times innovation."""
RISE, FALL, DRAIN = range(3)
"""Hypotheses of a change: the self-discharge rises; it falls; a balancer drains the cell while it may be active."""
HYPOTHESES = 3
"""Number of hypotheses."""


class ReadingFault(IntEnum):
    """Fault of the reading of a cell's voltage. The cell itself is intact."""

    NONE = 0
    STUCK = 1
    """The reading does not respond to the load."""
    CONTACT = 2
    """The error is proportional to the current, because a contact has a resistance."""
    OFFSET = 3
    """The error does not depend on the current."""
    SENSE_WIRE = 4
    """The neighbor's reading has the opposite error, because both cells share a faulty sense wire."""


CELL = np.dtype(
    [
        ("mean", "f8", STATES),
        ("covariance", "f8", (STATES, STATES)),
        ("sum_v", "f8"),  # sum of the voltages in the window [V]
        ("samples", "i8"),  # number of voltages in the window
        ("innovation_v", "f8"),  # measured less predicted deviation from the other cells, mean over two minutes [V]
        ("response", "f8", (HYPOTHESES, STATES)),  # error of the state for a change by 1/h that began at the restart
        ("score", "f8", HYPOTHESES),  # expected times measured innovation over the variance, sum since the restart
        ("information", "f8", HYPOTHESES),  # squared expected innovation over the variance, sum since the restart
        ("held_v", "f8"),  # voltage at its last change [V]
        ("held_reference_v", "f8"),  # median voltage of the cells when held_v changed [V]
        ("sums", "f8", 5),  # decaying sums since a jump of the innovation
        ("suspect_s", "f8"),  # time since a jump of the innovation [s]; 0: no jump
        ("recovered_s", "f8"),  # duration of readings that contradict the fault [s]
        ("error_ohm", "f8"),  # error of the reading per ampere [ohm]; minus the resistance of a contact
        ("offset_v", "f8"),  # part of the error that does not depend on the current [V]
        ("first_offset_v", "f8"),  # offset_v when the fault was confirmed [V]
        ("error_v", "f8"),  # magnitude of the error of the reading [V]; 0 without a fault
        ("fault", "i8"),  # a ``ReadingFault``
    ],
    align=True,
)
"""State of one cell."""

BANK_STATE = np.dtype(
    [
        ("started", "i8"),  # 1: a sample was processed
        ("time_s", "f8"),  # time of the last sample [s]
        # time without samples before the next sample, which may have another time base [s]
        ("unseen_s", "f8"),
        ("current_a", "f8"),  # current of the last sample [A]
        ("soc", "f8"),  # SOC of the pack at the last sample
        ("x_ts_a", "f8"),  # current filtered with tau_ts [A]
        ("x_tl_a", "f8"),  # current filtered with tau_tl [A]
        ("windows", "i8"),  # number of windows since the start
        ("samples", "i8"),  # number of samples in the window
        ("elapsed_s", "f8"),  # duration of the window [s]
        ("change", "f8"),  # change of the SOC in the window by coulomb counting
        ("throughput", "f8"),  # sum of charge and discharge in the window [SOC]
        ("sum_a", "f8"),  # sum of the currents in the window [A]
        ("sum_drop_v", "f8"),  # sum of the overpotentials of one cell in the window [V]
        ("gap", "i8"),  # 1: samples are missing in the window
        # remaining throughput until the cells are compared again, after one was nearly full [SOC]
        ("near_full_soc", "f8"),
        ("balancing_s", "f8"),  # duration for which a balancer may have been active [s]
    ],
    align=True,
)
"""State that all cells of a pack share: window sums, time, and SOC of the pack."""
