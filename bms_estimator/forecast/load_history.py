"""Observed load since the last long charge, second by second."""

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.forecast.load_seconds import LOAD, add_rows, copy_seconds
from bms_estimator.kernels.kalman_filter.current_offset import REST_C
from bms_estimator.kernels.kalman_filter.ekf import CHARGE_C
from bms_estimator.model.arrays import Floats, Records
from bms_estimator.model.unmeasured_time import UNMEASURED_S


class LoadHistory:
    """Mean and largest current of each second since the last long charge, in a buffer of constant size.

    Args:
        capacity_as: Capacity of the pack [A s].
        unmeasured_s: Longest step over which the current counts as measured [s].

    Attributes:
        record: Shape (1,), dtype ``LOAD``: the complete state, which can be copied, saved and restored.
    """

    def __init__(self, capacity_as: float, unmeasured_s: float = UNMEASURED_S) -> None:
        self.record: Records = np.zeros(1, LOAD)
        self._one_c_a, self._unmeasured_s = capacity_as / 3600.0, unmeasured_s

    def add(self, trace: TraceBlock) -> None:
        """Add rows of dtype ``TRACE``."""
        add_rows(self.record[0], trace, self._unmeasured_s, self._one_c_a)

    @property
    def seconds(self) -> int:
        """Number of stored seconds."""
        return int(self.record["count"][0])

    @property
    def rest_s(self) -> int:
        """Duration of the present rest [s]."""
        return int(self.record["rest_s"][0])

    @property
    def is_charging(self) -> bool:
        """True during a long charge, False during regeneration, which is shorter."""
        row = self.record[0]
        return bool(row["filtered_a"] < -CHARGE_C * self._one_c_a and row["last_a"] < -REST_C * self._one_c_a)

    @property
    def seen_a(self) -> tuple[float, float]:
        """Largest mean currents of a second so far [A], at least 0: of discharge and of charge."""
        row = self.record[0]
        return float(row["seen_discharge_a"]), float(row["seen_charge_a"])

    @property
    def mean_a(self) -> Floats:
        """Mean current of each second [A], oldest first, positive on discharge."""
        return self.mean_and_max()[0]

    @property
    def max_a(self) -> Floats:
        """Largest current of each second [A]."""
        return self.mean_and_max()[1]

    def mean_and_max(self) -> tuple[Floats, Floats]:
        """Return mean and largest current of each second [A], oldest first."""
        mean_a, max_a = np.empty(self.seconds), np.empty(self.seconds)
        copy_seconds(self.record[0], mean_a, max_a)
        return mean_a, max_a
