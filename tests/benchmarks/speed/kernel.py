"""Benchmark of the estimator's step: compared with C, with and without filter, and called from Python."""

import functools
import itertools
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels import step as kernel
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.speed.observer_in_c import ObserverInC
from tests.benchmarks.table import Row

BLOCK = 65_536
"""Number of samples of the block at 100 Hz."""
ROUNDS = 10
"""Number of measurements, of which the shortest counts."""
CALLS = 100_000
"""Maximum number of calls from Python in a measurement."""
SAMPLES_AT_1_HZ = 20_000
SAMPLES_WITH_ALL_HYPOTHESES = 50
"""Number of samples after switch-on during which all hypotheses exist."""
SAMPLES_UNTIL_ONE_HYPOTHESIS = 10_000
"""Number of samples after which one hypothesis certainly remains."""


def rows() -> Iterator[Row]:
    """Measure the observer step alone and in C, the whole step with the filter, and calls from Python."""
    block = pulses(BLOCK)
    kernel_ns, c_ns = kernel_and_c_ns(block)
    printed_law_ns, learning_law_ns = both_laws_ns(block)
    yield Row("observer step in run", "at most 300 ns", f"{kernel_ns:.0f} ns", kernel_ns <= 300.0)
    yield Row("  the same in C, -O3", "-", f"{c_ns:.0f} ns", None)
    yield Row("  ratio", "at most 1.15", f"{kernel_ns / c_ns:.2f}", kernel_ns <= 1.15 * c_ns)
    yield Row("observer step in run, the learning law", "-", f"{learning_law_ns:.0f} ns", None)
    yield Row("  the printed law in the same rounds", "-", f"{printed_law_ns:.0f} ns", None)
    whole_ns = whole_step_ns(block)
    yield Row(
        "whole step in run at 100 Hz: filter, history, observer, fits, margins",
        "at most 1 us",
        f"{whole_ns / 1e3:.2f} us",
        whole_ns <= 1000.0,
    )
    all_hypotheses_ns, several_ns, one_hypothesis_ns = steps_at_1_hz_ns()
    yield Row(
        "whole step at 1 Hz, seven hypotheses of the filter",
        "at most 10 us",
        f"{all_hypotheses_ns / 1e3:.1f} us",
        all_hypotheses_ns <= 10e3,
    )
    yield Row("  while several hypotheses remain", "at most 10 us", f"{several_ns / 1e3:.1f} us", several_ns <= 10e3)
    yield Row(
        "  once one hypothesis remains", "at most 4 us", f"{one_hypothesis_ns / 1e3:.1f} us", one_hypothesis_ns <= 4e3
    )
    yield Row("  the learning law without the filter", "-", f"{learning_at_1_hz_ns() / 1e3:.2f} us", None)
    step_ns, kernel_step_ns = calls_from_python_ns(block)
    overhead = step_ns - kernel_ns
    yield Row("Estimator.step from Python", "-", f"{step_ns / 1e3:.2f} us", None)
    yield Row("  kernel's step from Python", "-", f"{kernel_step_ns / 1e3:.2f} us", None)
    yield Row("  overhead over the kernel in run", "at most 2 us", f"{overhead / 1e3:.2f} us", overhead <= 2000.0)


def kernel_and_c_ns(block: SampleBlock) -> tuple[float, float]:
    """Return the time per sample of ``run`` and of its C version, measured alternately [ns]."""
    estimator, c_estimator = (Estimator(load_cell(CELL), identifier=None) for _ in range(2))
    estimator.settings_record["series_resistance"] = 0  # the C version does not estimate R_s
    trace = np.zeros(BLOCK, dtype=TRACE)
    with tempfile.TemporaryDirectory() as folder:
        observer_in_c = ObserverInC(Path(folder))

        def run_c() -> None:
            observer_in_c.run(c_estimator.record, c_estimator.settings_record, block, trace)

        def run_kernel() -> None:
            kernel.run(estimator.record, estimator.settings_record, block, trace)

        run_kernel()  # compiles the kernel
        best = np.full(2, np.inf)
        for _ in range(ROUNDS):
            best = np.minimum(best, [elapsed_ns(run_kernel), elapsed_ns(run_c)])
    return float(best[0]) / BLOCK, float(best[1]) / BLOCK


def both_laws_ns(block: SampleBlock) -> tuple[float, float]:
    """Return the time per sample of ``run`` with the printed and the learning law, measured alternately [ns]."""
    laws = [Estimator(load_cell(CELL), ObserverSettings(law=law), identifier=None) for law in ("improved", "learning")]
    best = np.full(2, np.inf)
    for estimator in laws:
        estimator.run(block)
    for _ in range(ROUNDS):
        for i, estimator in enumerate(laws):
            estimator.state["started"] = 0  # the next sample counts as the first
            best[i] = min(best[i], elapsed_ns(functools.partial(estimator.run, block)))
    return float(best[0]) / BLOCK, float(best[1]) / BLOCK


def whole_step_ns(block: SampleBlock) -> float:
    """Return the time per sample of ``run`` with the filter, including updates, fits and the rows of the history [ns]."""
    pack = pack_with_history()
    pack.run(block)
    best = np.inf
    for _ in range(ROUNDS):
        pack.estimator.state["started"] = 0
        best = min(best, elapsed_ns(lambda: pack.run(block)))
    return best / BLOCK


def pack_with_history() -> Pack:
    """Return a pack that records its history, as in the service, and never fits it."""
    estimator = Estimator(load_cell(CELL), identifier=IdentifierSettings())
    return Pack(estimator, SlowFit(estimator, interval_s=math.inf))


def learning_at_1_hz_ns() -> float:
    """Return the time per sample of ``run`` with the learning law on a counted SOC, with the samples of ``steps_at_1_hz_ns`` [ns]."""
    block = pulses(SAMPLES_AT_1_HZ, rate_hz=1)
    estimator = Estimator(load_cell(CELL), ObserverSettings(law="learning"), identifier=None)
    estimator.run(block)
    best = np.inf
    for _ in range(ROUNDS):
        estimator.state["started"] = 0
        estimator.run(block[:SAMPLES_UNTIL_ONE_HYPOTHESIS])
        best = min(best, elapsed_ns(lambda: estimator.run(block[SAMPLES_UNTIL_ONE_HYPOTHESIS:])))
    return best / (SAMPLES_AT_1_HZ - SAMPLES_UNTIL_ONE_HYPOTHESIS)


def steps_at_1_hz_ns() -> tuple[float, float, float]:
    """Return the time per sample with all hypotheses, while several remain, and with one [ns]."""
    block = pulses(SAMPLES_AT_1_HZ, rate_hz=1)
    edges = 0, SAMPLES_WITH_ALL_HYPOTHESES, samples_with_several_hypotheses(block), SAMPLES_AT_1_HZ
    best = np.full(3, np.inf)
    for _ in range(ROUNDS):
        pack = pack_with_history()
        parts = [functools.partial(pack.run, block[a:b]) for a, b in itertools.pairwise(edges)]
        best = np.minimum(best, [elapsed_ns(part) for part in parts])
    all_ns, several_ns, one_ns = (best / np.diff(edges)).tolist()
    return all_ns, several_ns, one_ns


def samples_with_several_hypotheses(block: SampleBlock) -> int:
    """Return the number of samples after switch-on during which the filter has several hypotheses."""
    pack, last = pack_with_history(), 0
    for begin in range(0, SAMPLES_UNTIL_ONE_HYPOTHESIS, SAMPLES_WITH_ALL_HYPOTHESES):
        pack.run(block[begin : begin + SAMPLES_WITH_ALL_HYPOTHESES])
        if pack.estimator.record[0]["filter"]["count"] > 1:
            last = begin + SAMPLES_WITH_ALL_HYPOTHESES
    return last


def calls_from_python_ns(block: SampleBlock) -> tuple[float, float]:
    """Return the time of ``Estimator.step`` and of the kernel's ``step``, called for single samples [ns]."""
    estimator = Estimator(load_cell(CELL), identifier=None)
    state, settings = estimator.record, estimator.settings_record
    # arguments of ``step``: time, current, voltage, status and temperature
    samples = [(float(x["time_s"]), float(x["current_a"]), float(x["voltage_v"]), 0, math.nan) for x in block[:CALLS]]

    def step() -> None:
        for sample in samples:
            estimator.step(*sample)

    def step_kernel() -> None:
        for sample in samples:
            kernel.step(state, settings, *sample)

    best = np.full(2, np.inf)
    for _ in range(3):
        for i, run in enumerate((step, step_kernel)):
            estimator.state["started"] = 0
            best[i] = min(best[i], elapsed_ns(run))
    return float(best[0]) / len(samples), float(best[1]) / len(samples)


def elapsed_ns(run: Callable[[], None]) -> int:
    """Return the CPU time of a call [ns], independent of other processes."""
    start = time.thread_time_ns()
    run()
    return time.thread_time_ns() - start
