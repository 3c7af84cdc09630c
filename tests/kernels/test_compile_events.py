"""Progress messages for kernels that are compiled."""

from bms_estimator.cli.options.compile_progress import show_compile_progress
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.compile_events import report_compilation
from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware import scaling


def fresh():
    """Return a kernel that is not in the cache."""
    return njit(chen_mora.crossing.py_func)


def test_each_newly_compiled_kernel_is_reported_once_with_its_number() -> None:
    told = []
    kernel = fresh()
    with report_compilation(lambda *what: told.append(what)):
        kernel(0.5, 1.0, 2.0)
        kernel(1, 1, 2)  # for other types
    [(name, number, most)] = told
    assert (name, number) == ("chen mora: crossing", 1)
    assert most >= 2
    with report_compilation(lambda *what: told.append(what)):
        kernel(0.6, 1.0, 2.0)
    assert len(told) == 1


def test_decoders_of_the_line_are_reported_too() -> None:
    told = []
    with report_compilation(lambda *what: told.append(what)):
        njit(scaling.running_mean.py_func)(0.0, 0.0, 1.0, 1.0, 0.0)
    [(name, _, _)] = told
    assert name == "scaling: running mean"


def test_nothing_is_reported_after_the_end() -> None:
    told = []
    with report_compilation(lambda *what: told.append(what)):
        pass
    fresh()(0.5, 1.0, 2.0)
    assert told == []


def test_without_a_terminal_lines_are_printed_at_intervals() -> None:
    lines: list[str] = []
    with show_compile_progress(lines.append):
        fresh()(0.5, 1.0, 2.0)
        njit(chen_mora.delta.py_func)(0.5, 1.0, 2.0)
    [line] = lines
    assert line.startswith("compiling kernels, once: 1/")
    assert line.endswith(" chen mora: crossing")
