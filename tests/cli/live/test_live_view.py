"""Live view on a real pseudo-terminal: its content on screens of any size; it does not block the service."""

import asyncio
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.pseudo_terminal import ALTERNATE, BACK, CURSOR, PseudoTerminal
from tests.serial_line import Line

TEN_SCREENS = 300
"""Number of samples at 100 Hz while ten screens are drawn. A pseudo-terminal that is not read buffers one or two screens."""


@pytest.fixture(scope="module")
def demo() -> Iterator[PseudoTerminal]:
    """Run ``demo`` on a terminal."""
    with PseudoTerminal("demo", "--port", str(free_port())) as terminal:
        yield terminal


def shows_soc(terminal: PseudoTerminal) -> bool:
    """Return True if the screen shows the SOC with its interval and the true SOC."""
    return re.search(r"demo +\d+\.\d\d ± \d+\.\d\d +\d+\.\d\d +live", "\n".join(terminal.screen())) is not None


@pytest.mark.parametrize(("columns", "rows"), [(40, 15), (80, 24)], ids=str)
def test_main_values_are_shown_on_any_screen_size(demo: PseudoTerminal, columns: int, rows: int) -> None:
    demo.resize(columns, rows)
    demo.until(lambda: len(demo.screen()) == rows and max(map(len, demo.screen())) == columns)
    demo.until(lambda: shows_soc(demo))


def test_unchanged_lines_are_not_drawn_with_each_screen(demo: PseudoTerminal) -> None:
    begin = len(demo.output)
    demo.until(lambda: len(set(re.findall(r"\d\d:\d\d:\d\dZ", demo.output[begin:]))) > 5)
    # a repaint and a resize draw the heading, too
    assert demo.output[begin:].count("Voltage") < 6


def test_interrupted_demo_prints_a_summary_and_restores_the_terminal(demo: PseudoTerminal) -> None:
    """This test ends the demo that the tests before it share."""
    demo.until(lambda: shows_soc(demo))
    demo.process.send_signal(signal.SIGINT)
    demo.until(demo.ended)
    demo.until(lambda: "lock\r\n" in demo.output)
    assert demo.process.returncode == 0
    assert demo.is_as_before()
    after_view = demo.output.split(ALTERNATE)[-1]
    assert [sequence for sequence in (BACK, CURSOR) if sequence not in after_view] == []
    assert re.search(r"SOC error -20\.00% at the start, ", after_view.replace("\r\n", " "))
    assert "Traceback" not in demo.output


@pytest.mark.thorough
async def test_service_with_a_blocked_terminal_publishes_and_ends_on_sigterm(
    tmp_path: Path, line: Line, broker: Broker
) -> None:
    line.plug()
    pack = tmp_path / "pack.toml"
    pack.write_text(f"""
[sensor]
port = "{line.path}"
protocol = "text"
[publish]
rate_hz = 10
[mqtt]
url = "{broker.url}"
[state]
folder = "{tmp_path / "state"}"
""")
    board = asyncio.create_task(_feed(line))
    async with Listener(broker) as listener:
        with PseudoTerminal("run", str(pack)) as terminal:
            await listener.wait_json("bms/pack/state", lambda s: s["frames_received"] > TEN_SCREENS)
            terminal.process.send_signal(signal.SIGTERM)
            assert await asyncio.to_thread(terminal.process.wait, LONG_S) == 0
    board.cancel()


async def _feed(line: Line) -> None:
    """Print text at 100 Hz, as a board does."""
    while True:
        line.write(b"3.80,0.10,25.0\r\n")
        await asyncio.sleep(0.01)
