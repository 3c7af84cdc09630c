"""Benchmark of the estimator's step: compared with C, with and without filter, and called from Python."""

import functools
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from load import CELL, pulses
from observer_in_c import ObserverInC
from table import Row

from bms_estimator.estimator import Estimator
from bms_estimator.kernels import step as kernel
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings

BLOCK = 65_536
ROUNDS = 10
CALLS = 100_000
AT_1_HZ = 20_000
"""Number of samples at 1 Hz."""
SAMPLES_WITH_ALL_HYPOTHESES = 50
"""Number of samples after switch-on during which all hypotheses exist."""
SAMPLES_UNTIL_ONE_HYPOTHESIS = 10_000
"""Number of samples after which one hypothesis remains."""


def rows() -> Iterator[Row]:
    """Measure kernel and C alternately on one block (best of all rounds), then calls from Python."""
    block = pulses(BLOCK)
    kernel_ns, c_ns = kernel_and_c(block)
    printed_law_ns, learning_law_ns = both_laws(block)
    yield Row("observer step in run", "at most 300 ns", f"{kernel_ns:.0f} ns", kernel_ns <= 300.0)
    yield Row("  the same in C, -O3 -march=native", "-", f"{c_ns:.0f} ns", None)
    yield Row("  ratio", "at most 1.5", f"{kernel_ns / c_ns:.2f}", kernel_ns <= 1.5 * c_ns)
    yield Row("observer step in run, the learning law", "-", f"{learning_law_ns:.0f} ns", None)
    yield Row("  the printed law in the same rounds", "-", f"{printed_law_ns:.0f} ns", None)
    whole_ns = whole_step(block)
    yield Row(
        "whole step in run at 100 Hz: filter, observer, map, margins",
        "at most 1 us",
        f"{whole_ns / 1e3:.2f} us",
        whole_ns <= 1000.0,
    )
    all_hypotheses_ns, one_hypothesis_ns = steps_at_1_hz()
    yield Row(
        "whole step at 1 Hz, seven filters side by side",
        "at most 20 us",
        f"{all_hypotheses_ns / 1e3:.1f} us",
        all_hypotheses_ns <= 20e3,
    )
    yield Row("  once they agree", "at most 4 us", f"{one_hypothesis_ns / 1e3:.1f} us", one_hypothesis_ns <= 4e3)
    yield Row("  the learning law without the filter", "-", f"{learning_at_1_hz() / 1e3:.2f} us", None)
    step_ns, kernel_step_ns = calls_from_python(block)
    overhead = step_ns - kernel_ns
    yield Row("Estimator.step from Python", "-", f"{step_ns / 1e3:.2f} us", None)
    yield Row("  kernel's step from Python", "-", f"{kernel_step_ns / 1e3:.2f} us", None)
    yield Row("  overhead over the kernel in run", "at most 2 us", f"{overhead / 1e3:.2f} us", overhead <= 2000.0)


def kernel_and_c(block: SampleBlock) -> tuple[float, float]:
    """Return the time per sample of ``run`` and of its C version [ns]."""
    estimator, c_estimator = (Estimator(load_cell(CELL), identifier=None) for _ in range(2))
    trace = np.zeros(BLOCK, dtype=TRACE)
    with tempfile.TemporaryDirectory() as folder:
        in_c = ObserverInC(Path(folder))

        def run_c() -> None:
            in_c.run(c_estimator.state, c_estimator.settings, block, trace)

        def run_kernel() -> None:
            kernel.run(estimator.record, estimator.settings_record, block, trace)

        run_kernel()
        best = np.full(2, np.inf)
        for _ in range(ROUNDS):
            best = np.minimum(best, [elapsed_ns(run_kernel), elapsed_ns(run_c)])
    return float(best[0]) / BLOCK, float(best[1]) / BLOCK


def both_laws(block: SampleBlock) -> tuple[float, float]:
    """Return the time per sample of ``run`` with the printed and the learning law, measured alternately [ns]."""
    laws = [Estimator(load_cell(CELL), ObserverSettings(law=law), identifier=None) for law in ("improved", "learning")]
    best = np.full(2, np.inf)
    for estimator in laws:
        estimator.run(block)
    for _ in range(ROUNDS):
        for i, estimator in enumerate(laws):
            estimator.state["started"] = 0
            best[i] = min(best[i], elapsed_ns(functools.partial(estimator.run, block)))
    return float(best[0]) / BLOCK, float(best[1]) / BLOCK


def whole_step(block: SampleBlock) -> float:
    """Return the time per sample of ``run`` with the filter, including updates and fits [ns]."""
    estimator = Estimator(load_cell(CELL), identifier=IdentifierSettings())
    estimator.run(block)
    best = np.inf
    for _ in range(ROUNDS):
        estimator.state["started"] = 0
        best = min(best, elapsed_ns(lambda: estimator.run(block)))
    return best / BLOCK


def learning_at_1_hz() -> float:
    """Return the time per sample of ``run`` with the learning law on a counted SOC, with the samples of ``steps_at_1_hz`` [ns]."""
    block = pulses(AT_1_HZ, rate_hz=1)
    estimator = Estimator(load_cell(CELL), ObserverSettings(law="learning"), identifier=None)
    estimator.run(block)
    best = np.inf
    for _ in range(ROUNDS):
        estimator.state["started"] = 0
        estimator.run(block[:SAMPLES_UNTIL_ONE_HYPOTHESIS])
        best = min(best, elapsed_ns(lambda: estimator.run(block[SAMPLES_UNTIL_ONE_HYPOTHESIS:])))
    return best / (AT_1_HZ - SAMPLES_UNTIL_ONE_HYPOTHESIS)


def steps_at_1_hz() -> tuple[float, float]:
    """Return the time per sample of ``run`` after switch-on, and with one remaining hypothesis [ns]."""
    block = pulses(AT_1_HZ, rate_hz=1)
    estimator = Estimator(load_cell(CELL), identifier=IdentifierSettings())
    estimator.run(block)
    all_hypotheses_ns, one_hypothesis_ns = np.inf, np.inf
    for _ in range(ROUNDS):
        estimator.state["started"] = 0
        all_hypotheses_ns = min(
            all_hypotheses_ns, elapsed_ns(lambda: estimator.run(block[:SAMPLES_WITH_ALL_HYPOTHESES]))
        )
        estimator.run(block[SAMPLES_WITH_ALL_HYPOTHESES:SAMPLES_UNTIL_ONE_HYPOTHESIS])
        one_hypothesis_ns = min(
            one_hypothesis_ns, elapsed_ns(lambda: estimator.run(block[SAMPLES_UNTIL_ONE_HYPOTHESIS:]))
        )
    return all_hypotheses_ns / SAMPLES_WITH_ALL_HYPOTHESES, one_hypothesis_ns / (AT_1_HZ - SAMPLES_UNTIL_ONE_HYPOTHESIS)


def calls_from_python(block: SampleBlock) -> tuple[float, float]:
    """Return the time of ``Estimator.step`` and of the kernel's ``step``, called for single samples [ns]."""
    estimator = Estimator(load_cell(CELL), identifier=None)
    state, settings = estimator.record, estimator.settings_record
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
