"""Alarms on single cells: self-discharge, wrong readings, and a weak cell in a bank."""

import math
from typing import TYPE_CHECKING

import numpy as np

from bms_estimator.kernels.alarms import CELLS_GAP_S
from bms_estimator.telemetry.alarms.alarm_list import AlarmList
from bms_estimator.telemetry.alarms.sample_intervals import SampleIntervals
from bms_estimator.telemetry.cells import NO_CELL_FAULT, CellFault, CellFaults

if TYPE_CHECKING:
    from bms_estimator.settings.alarms import AlarmName


class CellAlarms:
    """Alarms ``cell_short``, ``cell_sensor_fault`` and ``weak_cell``.

    Args:
        alarms: All alarms of the pack; the three are updated.
    """

    def __init__(self, alarms: AlarmList) -> None:
        self._alarms = alarms
        self._weak_cell_intervals = SampleIntervals(math.inf)  # no interval is a gap, because a weak cell remains weak
        self._cell_intervals = SampleIntervals(CELLS_GAP_S)
        self._described: dict[AlarmName, CellFault] = {}  # fault that the text of an alarm describes

    def evaluate_weak_cell(self, deviation_std: float, at_s: float, wall_offset_s: float) -> None:
        """Evaluate the alarm ``weak_cell``.

        Args:
            deviation_std: Deviation of the last discharge from the bank's reference [std].
            at_s: Time of the last sample [s].
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        time_s = np.array([at_s])
        _, observed_s = self._weak_cell_intervals.measure(time_s)
        self._alarms.update("weak_cell", time_s, observed_s, np.array([deviation_std]), wall_offset_s)

    def evaluate(self, faults: CellFaults, wall_offset_s: float) -> None:
        """Evaluate the alarms on faults of single cells.

        Args:
            faults: Faults at the last sample.
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        times_s = np.array([faults.at_s])
        _, observed_s = self._cell_intervals.measure(times_s)
        values: dict[AlarmName, CellFault] = {"cell_short": faults.short, "cell_sensor_fault": faults.reading}
        for name, fault in values.items():
            state = self._alarms.states.get(name)
            # the text of a raised alarm changes only with the kinds of its faults, because its numbers change often
            described = self._described.get(name, NO_CELL_FAULT)
            if state is not None and (state.raised is None or (fault.kinds and fault.kinds != described.kinds)):
                self._alarms.set_reasons(name, *fault.texts)
                self._described[name] = fault
            self._alarms.update(name, times_s, observed_s, np.array([fault.value]), wall_offset_s)
