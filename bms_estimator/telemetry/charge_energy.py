"""Charge and energy through the terminals of the pack, counted separately for each direction."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.accumulators.charge_energy import FLOW_SUMS, accumulate_charge_energy
from bms_estimator.model.payloads.health import Totals


class ChargeEnergy(NamedTuple):
    """Charge and energy through the terminals. No field ever decreases."""

    charge_out_ah: float = 0.0
    charge_in_ah: float = 0.0
    energy_out_kwh: float = 0.0
    energy_in_kwh: float = 0.0

    @classmethod
    def from_totals(cls, total: Totals) -> Self:
        """Return charge and energy of ``total``."""
        return cls(*(getattr(total, name) for name in cls._fields))

    def plus_net(self, charge_as: float, energy_ws: float) -> "ChargeEnergy":
        """Return the sum with net ``charge_as`` [A s] and ``energy_ws`` [W s], positive on discharge, each added to its direction."""
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
    """Integrates current and power by the trapezoidal rule, and adds nothing over a gap.

    Between two calls of ``update_totals`` the integral is net, so that current noise around zero does not count in both
    directions.

    Args:
        before: Charge and energy of the previous runs.
        gap_s: Minimum length of a gap, see ``kernels.step.is_gap`` [s].
        sums: External storage of the sums, shape (1,), dtype ``FLOW_SUMS``; None: internal.
    """

    def __init__(self, before: ChargeEnergy, gap_s: float, sums: NDArray[np.void] | None = None) -> None:
        self._gap_s = gap_s
        self._sums: NDArray[np.void] = np.zeros(1, dtype=FLOW_SUMS) if sums is None else sums
        self.continue_from(before)

    def continue_from(self, totals: ChargeEnergy) -> None:
        """Continue from ``totals``. The sums since the previous call of ``update_totals`` are added to them later."""
        self._totals = totals

    def add(self, trace: TraceBlock) -> None:
        """Add accepted samples; ``trace`` has shape (n,), dtype TRACE."""
        accumulate_charge_energy(self._sums, trace, self._gap_s)

    def update_totals(self) -> ChargeEnergy:
        """Add the net sums since the previous call, each to its direction. Return the totals so far."""
        s = self._sums[0]
        self._totals = self._totals.plus_net(float(s["charge_as"]), float(s["energy_ws"]))
        s["charge_as"] = s["energy_ws"] = 0.0
        return self._totals
