"""Charge and energy through the pack's terminals, counted in each direction."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.accumulators.charge_energy import FLOW_SUMS, accumulate_charge_energy
from bms_estimator.model.payloads import Totals


class ChargeEnergy(NamedTuple):
    """Charge and energy through the terminals; no field ever decreases."""

    charge_out_ah: float = 0.0
    charge_in_ah: float = 0.0
    energy_out_kwh: float = 0.0
    energy_in_kwh: float = 0.0

    @classmethod
    def of(cls, total: Totals) -> Self:
        """Return the charge and energy part of ``total``."""
        return cls(*(getattr(total, name) for name in cls._fields))

    def plus_net(self, charge_as: float, energy_ws: float) -> "ChargeEnergy":
        """And ``charge_as`` [A s] and ``energy_ws`` [W s], positive on discharge, each in the direction in which it went."""
        charge_ah, energy_kwh = charge_as / 3600.0, energy_ws / 3.6e6
        return ChargeEnergy(
            self.charge_out_ah + max(charge_ah, 0.0),
            self.charge_in_ah + max(-charge_ah, 0.0),
            self.energy_out_kwh + max(energy_kwh, 0.0),
            self.energy_in_kwh + max(-energy_kwh, 0.0),
        )

    def at_least(self, other: "ChargeEnergy") -> "ChargeEnergy":
        """Return the larger value of each field."""
        return ChargeEnergy(*map(max, self, other))


class ChargeEnergyMeter:
    """Counts what flows: straight between samples, nothing over a gap.

    Values are net between two readings of ``flow``, because current noise around zero must not count as energy out
    and in.

    Args:
        before: Counted by the runs before.
        gap_s: A step longer than this is a gap, unless the one before was about as long [s]; as ``kernels.step.is_gap``.
        sums: Shape (1,), dtype ``FLOW_SUMS``: external storage of the sums, if it is shared.
    """

    def __init__(self, before: ChargeEnergy, gap_s: float, sums: NDArray[np.void] | None = None) -> None:
        self._gap_s = gap_s
        self._sums: NDArray[np.void] = np.zeros(1, dtype=FLOW_SUMS) if sums is None else sums
        self.continue_from(before)

    def continue_from(self, flow: ChargeEnergy) -> None:
        """Count on from ``flow`` and what the sums hold."""
        self._flow = flow

    def add(self, trace: TraceBlock) -> None:
        """Take accepted samples; ``trace`` has shape (n,), dtype TRACE."""
        accumulate_charge_energy(self._sums, trace, self._gap_s)

    @property
    def flow(self) -> ChargeEnergy:
        """All that has flowed."""
        s = self._sums[0]
        self._flow = self._flow.plus_net(float(s["charge_as"]), float(s["energy_ws"]))
        s["charge_as"] = s["energy_ws"] = 0.0
        return self._flow
