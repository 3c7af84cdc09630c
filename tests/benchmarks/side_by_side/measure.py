"""Figures of a trial: every method learns from one capture and is evaluated on others."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.recipes import IN_MID_LOAD, cell_file, charge_ah
from tests.benchmarks.side_by_side.methods import FILE, LOWEST_SOC, METHODS, Learn, Learned, Method
from tests.benchmarks.side_by_side.references import (
    Pulses,
    Relaxations,
    pulse_resistance,
    relaxations,
    settling_time_s,
    with_resistance_step,
)
from tests.benchmarks.side_by_side.trials import Block, Trial, at_temperature, read_block, start_cells
from tests.estimator.anywhere.score import score

Starts = Iterable[tuple[float, CellModel]]
"""Initial cell models, each with the factor by which its resistances are wrong."""

ENTRY_SOC_ERROR, LEARNING_SOC_ERROR = 0.2, 0.1
"""Errors by which the initial SOC is too low: for the SOC estimate from mid-load, and for learning with a wrong SOC."""
R_S_STEP = 0.5
"""Relative size of the step of R_s."""
MIN_PULSES = 9
"""Minimum number of pulses of a reference: the length of the running median over pulses."""
ROUNDS = 9
"""Number of measurements of the time of a step."""
TIMED_ROWS = 20_000
"""Number of samples for the measurement of the time of a step."""

VOLTAGE, VOLTAGE_WRONG, SOC = "voltage", "voltage, learned at SOC -0.1", "SOC"
R_S, TAU_TS, TAU_TL = "R_s", "RC short", "RC long"
JUMP, STEP, FIT = "jump", "step", "fit"
"""Keys of the tables."""


@dataclass(frozen=True)
class Figure:
    """One measured value.

    Attributes:
        table: Key of its table.
        row: Name of its row.
        method: Name of the method.
        factor: Factor of the resistances at the start of learning.
        value: Measured value; NaN if the method failed.
        seed: Number of the seed of a stochastic method.
    """

    table: str
    row: str
    method: str
    factor: float
    value: float
    seed: int = 1


@dataclass(frozen=True)
class Reference:
    """References from the captures of a trial, which do not depend on a method."""

    trial: str
    rests: Relaxations
    pulses: Pulses


class Bench:
    """Captures, start cells and references of a trial.

    Attributes:
        learn: Capture to learn from.
        held_back: Captures to evaluate on, by name.
        first: The first of these.
        true_cell: Cell file at the temperature of the trial.
    """

    def __init__(self, trial: Trial, folder: Path) -> None:
        self.trial, self.capacity_ah = trial, trial.recipe.capacity_ah
        self.learn = above_lowest_soc(read_block(trial.learn, self.capacity_ah))
        self.held_back = {part.name: read_block(part, self.capacity_ah) for part in trial.held_back}
        self.first = next(iter(self.held_back.values()))
        self.true_cell = at_temperature(cell_file(trial.recipe, folder), trial.temperature_c)
        self.starts = tuple(start_cells(self.true_cell, trial.temperature_c))
        pulses_of_learn, self.pulses_of_first = (
            pulse_resistance(b, self.capacity_ah) for b in (self.learn, self.first)
        )
        pulses = pulses_of_learn if pulses_of_learn.ohm.size >= MIN_PULSES else self.pulses_of_first
        self.reference = Reference(trial.name, relaxations(self.learn, self.capacity_ah), pulses)

    def figures(self, method: Method, starts: Starts) -> Iterator[Figure]:
        """Yield the figures of one method, from each start and with each seed."""
        for factor, cell in starts:
            for seed, learn in enumerate((method.learn, *method.other_seeds), start=1):
                for figure in self._measure(method, learn, factor, cell):
                    yield replace(figure, seed=seed)

    def _measure(self, method: Method, learn: Learn, factor: float, cell: CellModel) -> Iterator[Figure]:
        """Yield the figures of one method from one start with one seed."""
        name = self.trial.name
        begin_s = time.thread_time()
        learned = learn(cell, self.learn.samples, float(self.learn.soc[0]))
        if learned is None:
            return
        if method.run is None:  # an offline method
            yield Figure(FIT, name, method.name, factor, time.thread_time() - begin_s)
        for capture, held in self.held_back.items():
            rms_mv = learned.voltage_rms_mv(held.samples, float(held.soc[0]))
            row = f"{name}: {capture.split('/')[1].split('_', 1)[1]}"
            yield Figure(VOLTAGE, row, method.name, factor, np.nan if rms_mv is None else rms_mv)
        for table, value in chain(self._elements(learned), self._tracking(learned)):
            yield Figure(table, name, method.name, factor, value)
        if method.other_seeds:  # a second fit with each of five seeds would take another half hour
            return
        misled = learn(cell, self.learn.samples, float(self.learn.soc[0]) - LEARNING_SOC_ERROR)
        if misled is not None:
            rms_mv = misled.voltage_rms_mv(self.first.samples, float(self.first.soc[0]))
            yield Figure(VOLTAGE_WRONG, name, method.name, factor, np.nan if rms_mv is None else rms_mv)

    def _elements(self, learned: Learned) -> Iterator[tuple[str, float]]:
        """Yield table and median error factor of each element, relative to the references."""
        rests, pulses = self.reference.rests, self.reference.pulses
        r_s = learned.elements(pulses.soc)[0]
        _, tau_ts, tau_tl = learned.elements(rests.soc)
        if pulses.ohm.size:
            yield R_S, error_factor(r_s, pulses.ohm)
        if rests.soc.size:
            yield TAU_TS, error_factor(tau_ts, rests.tau_ts_s)
            yield TAU_TL, error_factor(tau_tl, rests.tau_tl_s)

    def _tracking(self, learned: Learned) -> Iterator[tuple[str, float]]:
        """Yield table and value of what changes in the first held-back capture: error of the SOC, time to follow a step of R_s."""
        entered = from_mid_load(self.first)
        soc = learned.soc(entered.samples, max(float(entered.soc[0]) - ENTRY_SOC_ERROR, 0.0))
        if soc is not None:
            # The std is not used here, so that any value serves.
            scored = score(entered.samples["time_s"], soc, np.ones(soc.size), entered.soc)
            yield SOC, scored.rmse if scored else np.nan
        settling_min = self._settle_after_step(learned)
        if settling_min is not None:
            yield JUMP, settling_min

    def _settle_after_step(self, learned: Learned) -> float | None:
        """Return the time from a step of R_s until the estimate is correct again [min].

        The result is NaN if the estimate was not correct before the step, and None without pulses or without an estimate.
        """
        pulses = self.pulses_of_first
        if pulses.ohm.size < MIN_PULSES:
            return None
        more_ohm = R_S_STEP * float(np.median(pulses.ohm))
        changed, jump_s = with_resistance_step(self.first, more_ohm)
        estimated = learned.series_resistance(changed.samples, float(changed.soc[0]))
        if estimated is None:
            return None
        time_s, ohm = estimated
        true_ohm = np.interp(time_s, pulses.time_s, pulses.ohm) + more_ohm * (time_s >= jump_s)
        settling_s = settling_time_s(time_s, ohm / true_ohm, jump_s)
        return np.nan if settling_s is None else settling_s / 60.0


def measure_trial(trial: Trial, folder: Path) -> tuple[Reference, list[Figure]]:
    """Return the references and the figures of one trial by every method."""
    bench = Bench(trial, folder)
    figures = [figure for method in METHODS for figure in bench.figures(method, bench.starts)]
    return bench.reference, figures + list(bench.figures(FILE, [(1.0, bench.true_cell)]))


def error_factor(values: Floats, reference: Floats) -> float:
    """Return the median factor, at least 1, between values and reference; invalid values count as infinitely wrong."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ln_error = np.abs(np.log(values / reference))
    return float(np.exp(np.median(np.where(np.isfinite(ln_error), ln_error, np.inf))))


def above_lowest_soc(whole: Block) -> Block:
    """Return a capture until its SOC falls below ``LOWEST_SOC``, where no method learns or is evaluated."""
    below = np.flatnonzero(whole.soc < LOWEST_SOC)
    end = int(below[0]) if below.size else whole.soc.size
    return Block(whole.samples[:end], whole.soc[:end])


def from_mid_load(whole: Block) -> Block:
    """Return a capture from the sample at which the fraction ``IN_MID_LOAD`` of its charge has been drawn."""
    drawn_ah = charge_ah(whole.samples)
    begin = int(np.argmax(drawn_ah >= IN_MID_LOAD * drawn_ah[-1]))
    return Block(whole.samples[begin:], whole.soc[begin:])


def step_costs(cell: CellModel, samples: SampleBlock, row: str) -> Iterator[Figure]:
    """Yield the CPU time per sample of each method that is not offline [ns].

    The methods run in turn, and the median of the rounds is used, so that other processes affect all methods alike.
    """
    rows = samples[:TIMED_ROWS]
    calls = {m.name: m.run(cell, rows) for m in METHODS if m.run is not None}
    for call in calls.values():
        call()  # compiles kernels
    times_ns: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            begin_ns = time.thread_time_ns()
            call()
            times_ns[name].append((time.thread_time_ns() - begin_ns) / rows.size)
    for name, times_of_method_ns in times_ns.items():
        yield Figure(STEP, row, name, factor=1.0, value=float(np.median(times_of_method_ns)))
