"""Sums over the samples since the last publication, detection of rest from the means of these publish windows, and lifetime totals.

Rest is a condition for the calibration of the current sensor's zero.

Charge and energy through the terminals of the pack are counted separately for each direction.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.kernels.accumulators.publish_window import (
    FLOW_SUMS,
    WINDOW_SUMS,
    accumulate_charge_energy,
    accumulate_window,
)
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import NO_CELLS, NO_PROBES, CellBlock, Floats, ProbeBlock, Records
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.estimate import Estimate
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

    def __init__(self, before: ChargeEnergy, gap_s: float, sums: Records | None = None) -> None:
        self._gap_s = gap_s
        self._sums: Records = np.zeros(1, dtype=FLOW_SUMS) if sums is None else sums
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


def gap_lengths(times_s: Floats, before_s: float, step_s: float, gap_s: float, restart_s: float) -> list[float]:
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


REST_S = 30.0
"""Time for which current and voltage must have been constant [s]."""
MAX_CURRENT_FRACTION = 0.04
"""Maximum current at rest, as a fraction of the maximum current in the cell file. A sensor may have such an offset."""
MAX_VOLTAGE_STEPS = 2.0
"""Maximum range of the voltage at rest, in resolution steps (LSB) of the voltage."""


class RestDetector:
    """Detector of rest from the means of the publish windows.

    Args:
        current_max_a: Maximum current of the pack [A].
        voltage_resolution_v: Resolution (LSB) of the voltage [V].
    """

    def __init__(self, current_max_a: float, voltage_resolution_v: float) -> None:
        self._max_current_a, self._max_change_v = (
            MAX_CURRENT_FRACTION * current_max_a,
            MAX_VOLTAGE_STEPS * voltage_resolution_v,
        )
        self._windows: deque[tuple[float, float, float]] = deque()  # monotonic time [s], current [A], voltage [V]

    def add(self, estimate: Estimate, now_s: float) -> None:
        """Add the estimate of a publish window; ``now_s`` is the monotonic clock [s]."""
        self._windows.append((now_s, estimate.current_a, estimate.voltage_v))
        while len(self._windows) > 1 and now_s - self._windows[1][0] >= REST_S:
            self._windows.popleft()

    def reset(self) -> None:
        """Restart the detection after a gap in the samples."""
        self._windows.clear()

    def not_at_rest_reason(self, now_s: float) -> str | None:
        """Return the reason why the pack may not be at rest; None when it is at rest.

        Args:
            now_s: Monotonic clock [s].
        """
        watched_s = now_s - self._windows[0][0] if self._windows else 0.0
        if watched_s < REST_S:
            return f"the pack was watched for {watched_s:.0f} s only; wait until it is {REST_S:.0f} s"
        _, currents_a, voltages_v = zip(*self._windows, strict=True)
        current_a = max(currents_a, key=abs)
        if abs(current_a) > self._max_current_a:
            return (
                f"current flows: {current_a:.3g} A within the last {REST_S:.0f} s; at most {self._max_current_a:.3g} A"
            )
        moved_v = max(voltages_v) - min(voltages_v)
        if moved_v > self._max_change_v:
            return f"current flows: the voltage moved by {moved_v:.3g} V within the last {REST_S:.0f} s"
        return None


@dataclass(frozen=True)
class WindowSummary:
    """Means over one publish window, and its last trace row.

    Attributes:
        arrival_s: Wall clock at the arrival of the last block [s since 1970].
        samples: Number of samples.
        voltage_v: Mean voltage [V].
        current_a: Mean current [A], positive on discharge.
        power_w: Mean power [W].
        temperature_c: Mean temperature [C], NaN without a sensor.
        sample_rate_hz: Sample rate on the clock of the samples [Hz], NaN if unknown.
        last: Last row, dtype TRACE.
        soc_known: True if the SOC is known at the last row.
        cells_v: Last cell voltages [V], shape (m,), NaN if not reported; m is 0 without cell voltages.
        probes: Last temperature probes, shape (m,), dtype PROBE; m is 0 without a list of them.
    """

    arrival_s: float
    samples: int
    voltage_v: float
    current_a: float
    power_w: float
    temperature_c: float
    sample_rate_hz: float
    last: np.void
    soc_known: bool
    cells_v: Floats
    probes: ProbeBlock


class Window:
    """Sums over trace blocks since the last publication.

    Attributes:
        previous_end_s: Last time stamp of the previous window [s]; NaN before the first window.
        soc_known: True if the SOC is known at the last row of this window or an earlier one.
    """

    def __init__(self) -> None:
        self.previous_end_s, self.soc_known = math.nan, False
        self._sums: Records = np.zeros(1, dtype=WINDOW_SUMS)
        self._clear()

    def _clear(self) -> None:
        self._sums.fill(0)
        self._last: np.void | None = None
        self._arrival_s = math.nan
        self._cells, self._probes = NO_CELLS, NO_PROBES

    def add(
        self, trace: TraceBlock, arrival_s: float, cells: CellBlock = NO_CELLS, probes: ProbeBlock = NO_PROBES
    ) -> None:
        """Add the trace of one block.

        Args:
            trace: Accepted samples, shape (n,), dtype TRACE; n may be 0.
            arrival_s: Wall clock at the arrival of the block [s since 1970].
            cells: Cell voltages of the block.
            probes: Temperature probes of the block.
        """
        if cells.size:
            self._cells = cells[-1:]
        if probes.size:
            self._probes = probes[-1:]
        if trace.size:
            self.soc_known = accumulate_window(self._sums, trace, self.soc_known)
            # a copy of the record would copy field by field, which takes longer than the sums
            self._last = np.frombuffer(trace[-1:].tobytes(), trace.dtype)[0]
        self._arrival_s = arrival_s

    def take(self) -> WindowSummary | None:
        """Return the summary of the samples since the last call, and begin a new window. Return None without a sample."""
        if self._last is None:
            return None
        n, first_s, voltage, current, power, temperature_count, temperature = self._sums[0].item()
        last_s = float(self._last["time_s"])
        # the window begins at the last sample of the previous window, or at its own first sample
        steps, begin_s = (n, self.previous_end_s) if math.isfinite(self.previous_end_s) else (n - 1, first_s)
        span_s = last_s - begin_s
        summary = WindowSummary(
            arrival_s=self._arrival_s,
            samples=n,
            voltage_v=voltage / n,
            current_a=current / n,
            power_w=power / n,
            temperature_c=temperature / temperature_count if temperature_count else math.nan,
            sample_rate_hz=steps / span_s if span_s > 0.0 else math.nan,
            last=self._last,
            soc_known=self.soc_known,
            cells_v=self._cells.ravel(),
            probes=self._probes.ravel(),
        )
        self.previous_end_s = last_s
        self._clear()
        return summary
