"""Totals over all restarts: samples, crashes, unmeasured time, charge and energy."""

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads import Totals
from bms_estimator.model.sample import SampleBlock
from bms_estimator.telemetry.charge_energy import ChargeEnergy, ChargeEnergyMeter
from bms_estimator.telemetry.health import sample_counters


def new_totals(now_s: float) -> Totals:
    """Nothing is counted yet, at ``now_s`` [s since 1970]."""
    return Totals(since=iso_utc(now_s), crashes=0, samples={}, unseen_s=0.0)


class LifetimeTotals:
    """Passes blocks to the estimator and adds up their results.

    Args:
        estimator: Estimator of this run.
        before: Counted by the runs before.

    Attributes:
        estimator: Estimator.
        unseen_s: Length of the last unmeasured gap, also before the start [s]; None if there was none or it is unknown.
    """

    def __init__(self, estimator: Estimator, before: Totals) -> None:
        self.estimator, self._before = estimator, before
        self._meter = ChargeEnergyMeter(ChargeEnergy.of(before), float(estimator.settings["gap_s"][0]))
        self._unseen_s = 0.0  # of this run
        self.unseen_s: float | None = None

    @property
    def total(self) -> Totals:
        """Totals of all runs."""
        samples = Counter(self._before.samples)
        samples.update(sample_counters(self.estimator.state[0]))
        changed = {"samples": dict(samples), "unseen_s": self._before.unseen_s + self._unseen_s}
        return self._before.model_copy(update=changed | self.flow._asdict())

    @property
    def flow(self) -> ChargeEnergy:
        """Through the terminals, in all runs."""
        return self._meter.flow

    def run(self, block: SampleBlock) -> TraceBlock:
        """Run the estimator as ``Estimator.run`` does."""
        s = self.estimator.state
        before_s, step_s, gaps = float(s["time_s"][0]), float(s["step_s"][0]), int(s["gaps"][0])
        trace = self.estimator.run(block)
        self._meter.add(trace)
        if s["gaps"][0] != gaps or (trace.size and math.isinf(before_s)):
            restart_s = float(self.estimator.record["unseen_s"][0])
            gap_s = float(self.estimator.settings["gap_s"][0])
            lengths_s = gap_lengths(trace["time_s"], before_s, step_s, gap_s, restart_s)
            self._unseen_s += sum(lengths_s)
            self.unseen_s = lengths_s[-1] if lengths_s else None
        return trace


def gap_lengths(
    times_s: NDArray[np.float64], before_s: float, step_s: float, gap_s: float, restart_s: float
) -> list[float]:
    """Return the lengths of the gaps before some samples [s], as ``kernels.step.is_gap`` finds them.

    Args:
        times_s: Shape (n,): time stamps of accepted samples [s].
        before_s: Length of the previous step [s]; infinite at the first of a new clock.
        step_s: Length of the step before [s].
        gap_s: Minimum length of a gap [s].
        restart_s: Before the first sample of a new clock [s].
    """
    found = []
    for time_s in times_s:
        new_clock = math.isinf(before_s)
        length_s = restart_s if new_clock else float(time_s) - before_s
        before_s = float(time_s)
        if not 0.0 <= length_s < math.inf:
            continue
        if new_clock or length_s > max(gap_s, GAP_RATIO * step_s):
            found.append(length_s)
        if not new_clock:
            step_s = length_s
    return found
