"""Charge and energy through the pack's terminals, counted in each direction."""

import math
from typing import NamedTuple, Self

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.sample_step import GAP_RATIO
from bms_estimator.model.estimate import Totals

WAITING_ROWS = 1024
"""Rows are integrated so many at a time: at 1,000 blocks a second, one by one would take as long as the estimate."""


class Flow(NamedTuple):
    """What has gone through the terminals; none of it ever decreases."""

    charge_out_ah: float = 0.0
    charge_in_ah: float = 0.0
    energy_out_kwh: float = 0.0
    energy_in_kwh: float = 0.0

    @classmethod
    def of(cls, total: Totals) -> Self:
        """The part of ``total`` that has flowed."""
        return cls(*(getattr(total, name) for name in cls._fields))

    def and_net(self, charge_as: float, energy_ws: float) -> "Flow":
        """And ``charge_as`` [A s] and ``energy_ws`` [W s], positive on discharge, each in the direction in which it went."""
        charge_ah, energy_kwh = charge_as / 3600.0, energy_ws / 3.6e6
        return Flow(
            self.charge_out_ah + max(charge_ah, 0.0),
            self.charge_in_ah + max(-charge_ah, 0.0),
            self.energy_out_kwh + max(energy_kwh, 0.0),
            self.energy_in_kwh + max(-energy_kwh, 0.0),
        )

    def at_least(self, other: "Flow") -> "Flow":
        """The larger of each."""
        return Flow(*map(max, self, other))


class Last(NamedTuple):
    """The last sample that a meter has counted."""

    time_s: float = math.nan
    """NaN: none was."""
    current_a: float = 0.0
    power_w: float = 0.0
    step_s: float = 0.0
    """To it from the one before."""


class Meter:
    """Counts what flows: straight between samples, nothing over a gap.

    What comes is netted from one look at ``flow`` to the next: a current that is noise about zero must not count as energy
    out and in.

    Args:
        before: Counted by the runs before.
        gap_s: A step longer than this is a gap, unless the one before was about as long [s]; as ``kernels.sample_step.is_gap``.
    """

    def __init__(self, before: Flow, gap_s: float) -> None:
        self._gap_s = gap_s
        self._rows = np.zeros((3, 1 + WAITING_ROWS))  # time [s], current [A], power [W]; first the last of those before
        self.go_on(before, Last())

    def go_on(self, flow: Flow, last: Last) -> None:
        """Count on from ``flow`` and the last sample that it holds; what was taken before is forgotten."""
        self._flow, self._count = flow, 1
        *self._rows[:, 0], self._step_s = last

    def add(self, trace: TraceBlock) -> None:
        """Take accepted samples; ``trace`` has shape (n,), dtype TRACE."""
        for first in range(0, trace.size, WAITING_ROWS):
            part = trace[first : first + WAITING_ROWS]
            if self._count + part.size > self._rows.shape[1]:
                self._integrate()
            time_s, current_a, power_w = self._rows[:, self._count : self._count + part.size]
            time_s[:], current_a[:] = part["time_s"], part["current_a"]
            np.multiply(part["voltage_v"], part["current_a"], out=power_w)
            self._count += part.size

    @property
    def flow(self) -> Flow:
        """All that has flowed."""
        if self._count > 1:
            self._integrate()
        return self._flow

    @property
    def last(self) -> Last:
        """The last sample that ``flow`` holds."""
        time_s, current_a, power_w = self._rows[:, 0].tolist()
        return Last(time_s, current_a, power_w, self._step_s)

    def _integrate(self) -> None:
        """Count the waiting rows; the last of them stays, for the step to the next."""
        time_s, current_a, power_w = self._rows[:, : self._count]
        step_s = np.diff(time_s)
        before_s = np.concatenate(([self._step_s], step_s[:-1]))
        # NaN to the first sample of all, below 0 where the clock was set back: neither is counted
        counted_s = np.where((step_s > 0.0) & (step_s <= np.fmax(self._gap_s, GAP_RATIO * before_s)), step_s, 0.0)
        charge_as = 0.5 * float(counted_s @ (current_a[:-1] + current_a[1:]))
        energy_ws = 0.5 * float(counted_s @ (power_w[:-1] + power_w[1:]))
        self._flow = self._flow.and_net(charge_as, energy_ws)
        self._step_s = float(step_s[-1])
        self._rows[:, 0] = self._rows[:, self._count - 1]
        self._count = 1
