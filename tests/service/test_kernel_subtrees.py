"""Compilation in two processes: the same kernels, and the same estimates to the last bit, as in one process."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import event

from bms_estimator.service.kernel_subtrees import compile_subtrees
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.patience import LONG_S

REPLAY = """
import hashlib, os, sys
if sys.argv[1:] == ["alone"]:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from bms_estimator.service.kernel_warm_up import load_kernels
load_kernels()
import numpy as np
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SAMPLE
n = 20_000
samples = np.zeros(n, dtype=SAMPLE)
samples["time_s"] = 0.5 * np.arange(n)
samples["time_s"][n // 2 :] += 3 * 3600  # a gap
samples["current_a"] = np.repeat(np.random.default_rng(1).normal(0.02, 0.2, n // 50), 50)
samples["voltage_v"] = 3.9 - 0.2 * samples["current_a"] - 1e-5 * np.arange(n)
estimator = Estimator(load_cell("chen_mora"))
trace = estimator.run(samples)
print(hashlib.sha256(trace.tobytes() + estimator.record.tobytes()).hexdigest())
"""
"""Program that loads the kernels and prints a digest of the trace and the state of a replay."""


class CompiledKernels(event.Listener):
    """Listener that stores the names of the kernels that numba compiles."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def on_start(self, started: event.Event) -> None:
        """Store the name of a kernel."""
        self.names.append(started.data["dispatcher"].py_func.__qualname__)

    def on_end(self, _: event.Event) -> None:
        """Do nothing."""


def test_the_second_process_compiles_no_kernel_that_the_first_one_does_not_need():
    load_kernels()
    compiled = CompiledKernels()
    with event.install_listener("numba:compile", compiled):
        compile_subtrees()
    assert compiled.names == []


def cached_signatures(cache: Path) -> dict[str, set[str]]:
    """Return the signatures of each kernel in a cache folder."""
    signatures = {}
    for index in cache.rglob("*.nbi"):
        with index.open("rb") as file:
            _version, (_stamp, entries) = pickle.load(file), pickle.load(file)
        signatures[index.name] = {str(key[0]) for key in entries}
    return signatures


@pytest.mark.thorough
def test_two_processes_compile_the_same_kernels_as_one(tmp_path):
    digests = {}
    for mode in ("alone", "together"):
        variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / mode)}
        done = subprocess.run(
            [sys.executable, "-c", REPLAY, mode],
            env=variables,
            capture_output=True,
            text=True,
            timeout=5 * LONG_S,
            check=True,
        )
        digests[mode] = done.stdout
    assert digests["alone"] == digests["together"]
    alone = cached_signatures(tmp_path / "alone")
    assert len(alone) > 200
    assert alone == cached_signatures(tmp_path / "together")
