"""Live view on a real pseudo-terminal: content by screen size, without blocking the service."""

import re
import signal
from collections.abc import Iterator

import pytest

from tests.free_port import free_port
from tests.pseudo_terminal import ALTERNATE, BACK, CURSOR, PseudoTerminal

NEVER_CUT = (r"SOC \d+\.\d\d% ± \d+\.\d\d%", r"\d\.\d{3} V", r"[+-]\d\.\d{3} A", "health good")
SIZES = [(40, 15), (60, 20), (80, 24), (120, 40)]


@pytest.fixture(scope="module")
def demo() -> Iterator[PseudoTerminal]:
    with PseudoTerminal("demo", "--port", str(free_port())) as terminal:
        yield terminal


@pytest.mark.parametrize(("columns", "rows"), SIZES, ids=str)
def test_main_values_are_shown_on_any_screen_size(demo: PseudoTerminal, columns: int, rows: int) -> None:
    demo.resize(columns, rows)
    demo.until(lambda: len(demo.screen()) == rows and max(map(len, demo.screen())) == columns)
    demo.until(lambda: all(re.search(what, "\n".join(demo.screen())) for what in NEVER_CUT))
    demo.until(lambda: "true " in "".join(demo.screen()))


def test_interrupted_demo_prints_a_summary_and_restores_the_terminal() -> None:
    with PseudoTerminal("demo", "--port", str(free_port())) as terminal:
        terminal.until(lambda: "true " in "".join(terminal.screen()))
        terminal.process.send_signal(signal.SIGINT)
        terminal.until(terminal.ended)
        terminal.until(lambda: "lock\r\n" in terminal.output)
        assert terminal.process.returncode == 0
        assert terminal.is_as_before()
    last = terminal.output.split(ALTERNATE)[-1]
    assert BACK in last
    assert CURSOR in last
    assert re.search(r"SOC at first -20\.00% wrong, at last", last.replace("\r\n", " "))
    assert "Traceback" not in terminal.output
