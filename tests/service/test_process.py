"""The real program: signals, a kill, the broker's view of both, what it says when it cannot start."""

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.serial_line import Line

PROGRAM = Path(sys.executable).with_name("bms-estimator")


def pack_file(folder: Path, line: Line, broker: Broker) -> Path:
    path = folder / "pack.toml"
    path.write_text(
        f"""
[pack]
cell = "chen_mora"
initial_soc = 0.5
[sensor]
port = "{line.path}"
protocol = "text"
baud = 115200
[mqtt]
url = "{broker.url}"
publish_rate_hz = 10
[state]
folder = "{folder / "state"}"
"""
    )
    return path


@contextlib.asynccontextmanager
async def service(pack: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        str(PROGRAM), "run", str(pack), stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def feed(line: Line) -> None:
    """A board that prints text at 50 Hz."""
    while True:
        line.write(b"3.80,0.10,25.0\r\n")
        await asyncio.sleep(0.02)


async def test_a_killed_service_is_offline_by_its_will_and_one_that_is_asked_says_so_itself(
    tmp_path: Path, line: Line, broker: Broker
) -> None:
    line.plug()
    board = asyncio.create_task(feed(line))
    pack = pack_file(tmp_path, line, broker)
    async with Listener(broker) as live:
        async with service(pack) as process:
            state = await live.wait_json("bms/pack/state", lambda s: s["frames_received"] > 10)
            assert state["voltage_v"] == pytest.approx(3.8)
            assert state["temperature_c"] == pytest.approx(25.0)
            process.kill()
            await live.wait("bms/pack/availability", lambda p: p == b"offline")
        before = len(live.messages)
        async with service(pack) as process:
            await live.wait("bms/pack/state", skip=before)
            process.send_signal(signal.SIGTERM)
            assert await asyncio.wait_for(process.wait(), LONG_S) == 0
            assert process.stderr
            lines = (await process.stderr.read()).decode().splitlines()
        await live.wait("bms/pack/availability", lambda p: p == b"offline", skip=before)
    board.cancel()
    assert all(json.loads(line)["level"] for line in lines)  # a pipe gets JSON
    assert (tmp_path / "state" / "pack.npz").exists()
