"""Compilation in child processes: the recorded order, the end of a child, and a child that fails."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from bms_estimator.model.errors import TemporaryError
from bms_estimator.service import kernel_compilation
from bms_estimator.service.kernel_compilation import (
    Progress,
    background_compilation,
    compile_kernels,
    compile_order,
    is_compiled,
)
from tests.service.compile_order import callees

FIRST_START = """
import gc
import numpy as np
from numba.core import event
from numba.core.dispatcher import Dispatcher
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import new_pack
from bms_estimator.pack.state import CHECKPOINT
from bms_estimator.settings.pack import Settings
from bms_estimator.service.kernel_compilation import argument_types, compile_call, compile_order
from bms_estimator.service.kernel_warm_up import load_kernels
load_kernels()
model, samples = load_cell("chen_mora").pack(4, 1), np.zeros(1, SAMPLE)
samples["voltage_v"] = model.cell.nominal_voltage_v
pack, restarted = new_pack(Settings(), model), new_pack(Settings(), model)
pack.run(samples, np.full((1, 4), samples["voltage_v"] / 4))
outcomes = restarted.restore(pack.state(CHECKPOINT), 60.0)
gc.unfreeze()
kernels = [each for each in gc.get_objects() if isinstance(each, Dispatcher) and each.py_func.__module__.startswith("bms_estimator.")]
loaded = {(f"{each.py_func.__module__}.{each.py_func.__qualname__}", types) for each in kernels for types in each.signatures}
names = argument_types()
calls = [kernel.call.split(" ", 1) for kernel in compile_order()]
recorded = {(f"bms_estimator.{name}", eval(types, names)) for name, types in calls}
with event.install_recorder("numba:compile") as compiled:
    for kernel in compile_order():
        compile_call(kernel.call, names)
print(outcomes["checkpoint"][:8], bool(loaded), loaded - recorded, compiled.buffer)
"""
"""Program that prints kernels of a first start and a restart that the order lacks, and kernels of the order that they do not compile."""


def test_the_recorded_order_is_that_of_this_version() -> None:
    """If it fails: ``make compile-order``."""
    assert subprocess.check_output([sys.executable, "-c", FIRST_START], text=True) == "restored True set() []\n"


def test_the_order_contains_the_kernels_that_its_kernels_call() -> None:
    """numba does not load callees from a full cache, so that the test of the recorded order does not see them."""
    names = [kernel.call.split(" ")[0].rpartition(".") for kernel in compile_order()]
    kernels = {getattr(importlib.import_module(f"bms_estimator.{module}"), name) for module, _, name in names}
    assert {each for kernel in kernels for each in callees(kernel)} <= kernels


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty cache folder, and reduce the order to a few kernels."""
    order = [kernel for kernel in compile_order() if ".chen_mora." in kernel.call][:2]
    monkeypatch.setattr(kernel_compilation, "compile_order", lambda: order)
    monkeypatch.setattr(kernel_compilation, "CACHE_FOLDER", tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def test_each_child_ends_at_its_limit_and_the_next_one_continues(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_compilation, "MAX_CHILD_BYTES", 1)
    started, reports = [], list[Progress]()
    popen = kernel_compilation.subprocess.Popen
    monkeypatch.setattr(kernel_compilation.subprocess, "Popen", lambda *a, **k: started.append(a) or popen(*a, **k))
    assert not is_compiled()
    compile_kernels(reports.append)
    assert is_compiled()
    assert len(started) == len(list(cache.rglob("*.nbc"))) == 2
    assert reports[-1].all_kernels == 2
    compile_kernels(reports.append)
    assert len(started) == 2


def test_a_compilation_in_the_background_is_finished_with_its_progress(cache: Path) -> None:
    reports = list[Progress]()
    with background_compilation() as finish:
        finish(reports.append)
    assert (is_compiled(), reports[-1].all_kernels) == (True, 2)


def test_a_compilation_in_the_background_ends_with_its_context(cache: Path) -> None:
    with background_compilation():
        assert not is_compiled()
    assert not is_compiled()


def test_a_compilation_that_fails_in_the_background_is_repeated(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with background_compilation() as finish, pytest.raises(TemporaryError, match="the compiler ended 3 times"):
        finish(lambda _: None)


def test_a_compiler_that_is_killed_is_an_error_that_names_the_memory(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(TemporaryError, match="the compiler ended 3 times; it needs 256 MiB of memory"):
        compile_kernels()
    assert not is_compiled()
