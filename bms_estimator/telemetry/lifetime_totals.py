"""Totals over all runs of the service: samples, crashes, time without samples, charge and energy.

Charge and energy through the terminals of the pack are counted separately for each direction.
"""

import math
from collections import Counter
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.accumulators.charge_energy import FLOW_SUMS, accumulate_charge_energy
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.health import Totals
from bms_estimator.telemetry.health import sample_counters


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
        """Return the sum with net ``charge_as`` [A s] and ``energy_ws`` [W s], positive on discharge, by direction."""
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
    """Integrator of current and power by the trapezoidal rule. Gaps add nothing.

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


def new_totals(now_s: float) -> Totals:
    """Return zero totals whose counting starts at ``now_s`` [s since 1970]."""
    return Totals(since=iso_utc(now_s), crashes=0, samples={}, unseen_s=0.0)


class LifetimeTotals:
    """Totals of the previous runs and of this run.

    Args:
        estimator: Estimator of this run, with its state restored; read only.
        before: Totals of the previous runs.

    Attributes:
        unseen_s: Length of the last gap without samples, which may have begun before this run [s]; None without a gap
            or if its length is unknown.
    """

    def __init__(self, estimator: Estimator, before: Totals) -> None:
        self._estimator, self._before = estimator, before
        self._gap_s = float(estimator.settings["gap_s"][0])
        self._meter = ChargeEnergyMeter(ChargeEnergy.from_totals(before), self._gap_s)
        self._last_time_s, self._last_step_s, self._gap_count = self._last_step()
        self._gaps_s = 0.0  # total length of the gaps in this run [s]
        self.unseen_s: float | None = None

    @property
    def total(self) -> Totals:
        """Totals of all runs."""
        samples = Counter(self._before.samples)
        samples.update(sample_counters(self._estimator.state[0]))
        changed = {"samples": dict(samples), "unseen_s": self._before.unseen_s + self._gaps_s}
        return self._before.model_copy(update=changed | self.charge_energy._asdict())

    @property
    def charge_energy(self) -> ChargeEnergy:
        """Charge and energy through the terminals in all runs."""
        return self._meter.update_totals()

    def add(self, trace: TraceBlock) -> None:
        """Add the accepted samples of a block that the estimator has just run.

        Args:
            trace: Shape (n,), dtype TRACE.
        """
        self._meter.add(trace)
        time_s, step_s, gaps = self._last_step()
        # an infinite last time: the first sample after a restart
        if gaps != self._gap_count or (trace.size and math.isinf(self._last_time_s)):
            restart_s = float(self._estimator.record["unseen_s"][0])
            lengths_s = gap_lengths(trace["time_s"], self._last_time_s, self._last_step_s, self._gap_s, restart_s)
            self._gaps_s += sum(lengths_s)
            self.unseen_s = lengths_s[-1] if lengths_s else None
        self._last_time_s, self._last_step_s, self._gap_count = time_s, step_s, gaps

    def _last_step(self) -> tuple[float, float, int]:
        """Return the estimator's last time stamp [s], its last step [s] and its number of gaps."""
        state = self._estimator.state[0]
        return float(state["time_s"]), float(state["step_s"]), int(state["gaps"])


def gap_lengths(
    times_s: NDArray[np.float64], before_s: float, step_s: float, gap_s: float, restart_s: float
) -> list[float]:
    """Return the lengths of the gaps among some samples [s]; gaps are defined by ``kernels.step.is_gap``.

    Args:
        times_s: Time stamps of accepted samples [s], shape (n,).
        before_s: Time stamp of the sample before the first [s]; infinite if the device's clock restarted since.
        step_s: Time between the two samples before the first [s].
        gap_s: Minimum length of a gap [s].
        restart_s: Time without samples before the first sample of a restarted clock [s].
    """
    lengths_s = []
    for time_s in times_s:
        new_clock = math.isinf(before_s)
        length_s = restart_s if new_clock else float(time_s) - before_s
        before_s = float(time_s)
        if not 0.0 <= length_s < math.inf:  # the clock was set back, or the length is unknown
            continue
        if new_clock or length_s > max(gap_s, GAP_RATIO * step_s):
            lengths_s.append(length_s)
        if not new_clock:
            step_s = length_s
    return lengths_s
