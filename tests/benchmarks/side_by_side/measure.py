"""One trial: every method learns, and each figure is taken of it."""

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
    settled_after,
    with_jump,
)
from tests.benchmarks.side_by_side.trials import Block, Trial, at_temperature, block, starts
from tests.estimator.anywhere.score import score

Starts = Iterable[tuple[float, CellModel]]

WRONG_SOC, LEARNED_AT = 0.2, 0.1
"""Error of the initial SOC of a capture, and of the SOC given while learning."""
GROWN_BY = 0.5
"""Relative step of R_s."""
MIN_PULSES = 9
ROUNDS = 9
TIMED_ROWS = 20_000

VOLTAGE, VOLTAGE_WRONG, SOC = "voltage", "voltage, learned at SOC -0.1", "SOC"
R_S, TAU_TS, TAU_TL = "R_s", "RC short", "RC long"
JUMP, STEP, FIT = "jump", "step", "fit"


@dataclass(frozen=True)
class Figure:
    """One number: of which table, which row of it, which method, from which start, by which seed of a random method."""

    table: str
    row: str
    method: str
    factor: float
    value: float
    seed: int = 1


@dataclass(frozen=True)
class Reference:
    """References from the captures of a trial."""

    trial: str
    rests: Relaxations
    pulses: Pulses


class Bench:
    """A trial's captures, read once."""

    def __init__(self, trial: Trial, folder: Path) -> None:
        self.trial, self.capacity_ah = trial, trial.recipe.capacity_ah
        self.learn = above(block(trial.learn, self.capacity_ah))
        self.held_back = {part.name: block(part, self.capacity_ah) for part in trial.held_back}
        self.first = next(iter(self.held_back.values()))
        self.right = at_temperature(cell_file(trial.recipe, folder), trial.temperature_c)
        self.starts = tuple(starts(self.right, trial.temperature_c))
        learned_from, tried_on = (pulse_resistance(b, self.capacity_ah) for b in (self.learn, self.first))
        shown = learned_from if learned_from.ohm.size >= MIN_PULSES else tried_on
        self.reference = Reference(trial.name, relaxations(self.learn, self.capacity_ah), shown)
        self.tried_on = tried_on

    def figures(self, method: Method, starts: Starts) -> Iterator[Figure]:
        """Return the figures of one method, from each start."""
        for factor, cell in starts:
            for seed, learn in enumerate((method.learn, *method.other_seeds), start=1):
                for figure in self._of_one(method, learn, factor, cell):
                    yield replace(figure, seed=seed)

    def _of_one(self, method: Method, learn: Learn, factor: float, cell: CellModel) -> Iterator[Figure]:
        """Return the figures of one method from one start with one seed."""
        name = self.trial.name
        begin = time.thread_time()
        learned = learn(cell, self.learn.samples, float(self.learn.soc[0]))
        if learned is None:
            return
        if method.run is None:
            yield Figure(FIT, name, method.name, factor, time.thread_time() - begin)
        for capture, held in self.held_back.items():
            rms_mv = learned.voltage_rms_mv(held.samples, float(held.soc[0]))
            row = f"{name}: {capture.split('/')[1].split('_', 1)[1]}"
            yield Figure(VOLTAGE, row, method.name, factor, np.nan if rms_mv is None else rms_mv)
        for table, value in chain(self._elements(learned), self._tracking(learned)):
            yield Figure(table, name, method.name, factor, value)
        if method.other_seeds:  # five fits more would take another half hour
            return
        misled = learn(cell, self.learn.samples, float(self.learn.soc[0]) - LEARNED_AT)
        if misled is not None:
            rms_mv = misled.voltage_rms_mv(self.first.samples, float(self.first.soc[0]))
            yield Figure(VOLTAGE_WRONG, name, method.name, factor, np.nan if rms_mv is None else rms_mv)

    def _elements(self, learned: Learned) -> Iterator[tuple[str, float]]:
        """Return the median error factors of the elements relative to the references."""
        rests, pulses = self.reference.rests, self.reference.pulses
        r_s = learned.elements(pulses.soc)[0]
        _, tau_ts, tau_tl = learned.elements(rests.soc)
        if pulses.ohm.size:
            yield R_S, off_by(r_s, pulses.ohm)
        if rests.soc.size:
            yield TAU_TS, off_by(tau_ts, rests.tau_ts_s)
            yield TAU_TL, off_by(tau_tl, rests.tau_tl_s)

    def _tracking(self, learned: Learned) -> Iterator[tuple[str, float]]:
        """SOC of the first capture held back when entered in mid-load, and how soon a jump of R_s is found there."""
        entered = in_mid_load(self.first)
        soc = learned.soc(entered.samples, max(float(entered.soc[0]) - WRONG_SOC, 0.0))
        if soc is not None:
            judged = score(entered.samples["time_s"], soc, np.ones(soc.size), entered.soc)
            yield SOC, judged.rmse if judged else np.nan
        jump_min = self._jump(learned)
        if jump_min is not None:
            yield JUMP, jump_min

    def _jump(self, learned: Learned) -> float | None:
        """Minutes until R_s is right again; NaN where it was not before, None where nothing shows it."""
        pulses = self.tried_on
        if pulses.ohm.size < MIN_PULSES:
            return None
        more_ohm = GROWN_BY * float(np.median(pulses.ohm))
        jumped, jump_s = with_jump(self.first, more_ohm)
        said = learned.series_resistance(jumped.samples, float(jumped.soc[0]))
        if said is None:
            return None
        time_s, ohm = said
        true = np.interp(time_s, pulses.time_s, pulses.ohm) + more_ohm * (time_s >= jump_s)
        settled_s = settled_after(time_s, ohm / true, jump_s)
        return np.nan if settled_s is None else settled_s / 60.0


def of_trial(trial: Trial, folder: Path) -> tuple[Reference, list[Figure]]:
    """References and figures of one trial, by every method."""
    bench = Bench(trial, folder)
    figures = [figure for method in METHODS for figure in bench.figures(method, bench.starts)]
    return bench.reference, figures + list(bench.figures(FILE, [(1.0, bench.right)]))


def off_by(values: Floats, reference: Floats) -> float:
    """Return the median error factor; 1 is exact, infinite without values."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ln = np.abs(np.log(values / reference))
    return float(np.exp(np.median(np.where(np.isfinite(ln), ln, np.inf))))


def above(whole: Block) -> Block:
    """The capture until its SOC falls below ``LOWEST_SOC``: nothing is judged there, nor is it learned from."""
    below = np.flatnonzero(whole.soc < LOWEST_SOC)
    end = int(below[0]) if below.size else whole.soc.size
    return Block(whole.samples[:end], whole.soc[:end])


def in_mid_load(whole: Block) -> Block:
    """The capture from where a part of its charge is drawn."""
    drawn_ah = charge_ah(whole.samples)
    begin = int(np.argmax(drawn_ah >= IN_MID_LOAD * drawn_ah[-1]))
    return Block(whole.samples[begin:], whole.soc[begin:])


def step_costs(cell: CellModel, samples: SampleBlock, row: str) -> Iterator[Figure]:
    """Processor time of a sample by each method that steps, all in turn, the median of the rounds [ns]."""
    rows = samples[:TIMED_ROWS]
    calls = {m.name: m.run(cell, rows) for m in METHODS if m.run is not None}
    for call in calls.values():
        call()
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            begin = time.thread_time_ns()
            call()
            spent[name].append((time.thread_time_ns() - begin) / rows.size)
    for name, each in spent.items():
        yield Figure(STEP, row, name, 1.0, float(np.median(each)))
