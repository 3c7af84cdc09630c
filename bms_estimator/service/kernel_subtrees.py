"""Second process that compiles a part of the kernels during a first start.

The first process compiles the kernels in the order in which they are called. The second one begins with the kernels that
the first one reaches last. Both use the cache of ``numba_cache``, so that no kernel is compiled twice.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numba import typeof, types
from numba.core import event

from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.kernels import identifier
from bms_estimator.kernels.accumulators import history
from bms_estimator.kernels.kalman_filter import (
    anchors,
    ekf,
    equivalent_circuit,
    hypotheses,
    input_checks,
    mixture,
    step_resistance,
    window,
)
from bms_estimator.kernels.observer import learning_law, observer
from bms_estimator.kernels.step import write_filter_trace, write_margin
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.cell import load_cell
from bms_estimator.numba_cache import CACHE_FOLDER
from bms_estimator.process.child_process import ends_with_us
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.settings.pack import Settings

CELL = "chen_mora"
"""Cell file of the warm-up. Any file would do, because the kernels do not depend on the cell."""

MIN_MEMORY_BYTES = 1.5e9
"""Minimum memory of a machine on which two processes compile [bytes]. Together they take up to 0.9e9."""


def numba_type(value: Any) -> Any:
    """Return numba's type of a value, for example of a record."""
    return typeof(value)  # type: ignore[no-untyped-call]


def compile_subtrees() -> None:
    """Compile kernels with all kernels that they call, in the order in which the first process needs them."""
    estimator = make_estimator(Settings(), load_cell(CELL))
    # names as in the kernels: s state, p settings, f state of the filter, fp settings of the filter
    s, p, row = (numba_type(array[0]) for array in (estimator.record, estimator.settings_record, np.zeros(1, TRACE)))
    f, fp = s.typeof("filter"), p.typeof("filter")
    checks, counters, rows = s.typeof("checks"), s.typeof("counters"), s.typeof("history")
    real, whole, truth = types.float64, types.int64, types.boolean
    signatures: tuple[tuple[Any, tuple[Any, ...]], ...] = (
        (ekf.update, (f, fp, whole, real)),
        (equivalent_circuit.write_equivalent_circuit, (f, fp, s.typeof("elements"))),
        (learning_law.initialize_learning, (s, p, real)),
        (history.begin_segment, (rows, real, real, real)),
        (mixture.merge_all, (f,)),
        (hypotheses.spawn_after_gap, (f, fp, real, truth)),
        (history.add_window, (rows, f, fp)),
        (anchors.detect_anchor, (s.typeof("anchors"), p.typeof("anchors"), f, fp, real, real, real)),
        (identifier.correct_at_anchor, (s, p, whole)),
        (input_checks.restore_if_not_finite, (checks, counters, f, fp, real)),
        (input_checks.update_input_faults, (checks, f, fp, real)),
        (identifier.add_elements_to_map, (s, p, real)),
        (window.integrate_current, (f, fp, real, truth, real, real)),
        (identifier.accept_voltage, (s, p, real, real, real)),
        (identifier.coast, (s, p, real, real)),
        (step_resistance.detect_current_step, (f, fp, real, real, real)),
        (identifier.fit_next_element, (s, p)),
        (learning_law.learning_step, (s, p, real, real, real)),
        (observer.observer_step, (s.typeof("observer"), p.typeof("observer"), real, real)),
        (write_filter_trace, (row, s, p)),
        (write_margin, (row, s, p)),
    )
    for kernel, signature in signatures:
        kernel.compile(signature)
    _ = FrameDecoder().clock_ppm


@contextmanager
def second_process() -> Iterator[None]:
    """Start the second process as soon as a kernel compiles; end it at the end of the context.

    It is not started if all kernels are cached, if there is no cache, if this process has only one CPU, or if the machine
    has less memory than ``MIN_MEMORY_BYTES``.
    """
    starter = _Starter()
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if CACHE_FOLDER is None or len(os.sched_getaffinity(0)) == 1 or memory_bytes < MIN_MEMORY_BYTES:
        yield
        return
    try:
        with event.install_listener("numba:compile", starter):
            yield
    finally:
        starter.stop()


class _Starter(event.Listener):
    """Listener for functions that numba compiles. Cached functions cause no event."""

    _process: subprocess.Popen[bytes] | None = None

    def on_start(self, _: event.Event) -> None:
        """Start the second process, once."""
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603 - this module
                [sys.executable, "-P", "-m", __name__],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # the first process compiles what the second one cannot, and reports errors
                start_new_session=True,  # Ctrl-C in the terminal ends only the first process
                preexec_fn=ends_with_us(),  # noqa: PLW1509 - safe, because only this thread runs now
            )

    def on_end(self, _: event.Event) -> None:
        """Do nothing: the end of a compilation is not needed."""

    def stop(self) -> None:
        """End the second process."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


if __name__ == "__main__":
    compile_subtrees()
