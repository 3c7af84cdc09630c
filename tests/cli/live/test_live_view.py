"""The live view on a real pseudo-terminal: its content by size, and that nothing waits for it."""

import re
import signal
from collections.abc import Iterator

import pytest

from tests.free_port import free_port
from tests.pseudo_terminal import ALTERNATE, BACK, CURSOR, PseudoTerminal

SIZES = [(40, 15), (60, 20), (80, 24), (120, 40)]


@pytest.fixture(scope="module")
def demo() -> Iterator[PseudoTerminal]:
    with PseudoTerminal("demo", "--port", str(free_port())) as terminal:
        yield terminal


def shows_soc(terminal: PseudoTerminal) -> bool:
    """Return whether the screen has the SOC with its band and the true SOC."""
    return re.search(r"demo +\d+\.\d\d ± \d+\.\d\d +\d+\.\d\d +live", "\n".join(terminal.screen())) is not None


@pytest.mark.parametrize(("columns", "rows"), SIZES, ids=str)
def test_a_screen_of_any_size_shows_soc_band_and_true_soc(demo: PseudoTerminal, columns: int, rows: int) -> None:
    demo.resize(columns, rows)
    demo.until(lambda: len(demo.screen()) == rows and max(map(len, demo.screen())) == columns)
    demo.until(lambda: shows_soc(demo))


def test_a_demo_that_is_interrupted_says_what_came_of_it_and_leaves_the_terminal_as_it_was() -> None:
    with PseudoTerminal("demo", "--port", str(free_port())) as terminal:
        terminal.until(lambda: shows_soc(terminal))
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
