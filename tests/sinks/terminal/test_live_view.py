"""Nobody waits for the console."""

import asyncio
import signal
from pathlib import Path

from tests.cli.live.test_demo import listening
from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.pseudo_terminal import PseudoTerminal
from tests.serial_line import Line

TEN_SCREENS = 300
"""So many samples at 100 Hz come while ten screens are drawn; a pseudo-terminal takes one or two."""


async def test_a_terminal_that_nobody_reads_does_not_stop_the_estimate() -> None:
    port = free_port()
    with PseudoTerminal("demo", "--port", str(port)) as terminal:
        listener = await listening(port)
        try:
            await listener.wait_json("bms/demo/state", lambda s: s["frames_received"] > TEN_SCREENS)
        finally:
            await listener.__aexit__(None, None, None)
        terminal.process.send_signal(signal.SIGINT)
        terminal.until(terminal.ended)
        assert terminal.process.returncode == 0


async def test_a_service_ends_when_told_though_nobody_reads_its_terminal(
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
    """A board that prints text at 100 Hz."""
    while True:
        line.write(b"3.80,0.10,25.0\r\n")
        await asyncio.sleep(0.01)
