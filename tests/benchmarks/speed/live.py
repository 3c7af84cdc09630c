"""Benchmark of the real service between a board on a pseudo-terminal and a Mosquitto subscriber, all as processes."""

import asyncio
import json
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import aiomqtt
import numpy as np
import psutil
from numpy.typing import NDArray

from bms_estimator.protocols.firmware.messages import SampleMessage
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.table import Row
from tests.mosquitto import MOSQUITTO, Broker

PROGRAM = Path(sys.executable).with_name("bms-estimator")
PUBLISH_RATE_HZ = 10
"""Publish rate of the service, the highest that its settings permit [Hz]. Each message has the newest sample of its window."""
SETTLE_S = 2.0
"""Time from the first estimate to the measurement [s]."""
MEASURE_S = 20.0
"""Duration of the measurement [s]."""
PATIENCE_S = 30.0
"""Timeout of the first estimate, and of the end of the service [s]."""
BARE_MESSAGES = 100
"""Number of messages that are published without the service, for comparison."""
BARE_BYTES = 945
"""Size of these messages, which is the size of a state message [bytes]."""
MAX_S = 120
"""Duration of the readings that are prepared for a board, longer than any run [s]."""

PACK_TOML = """
[pack]
name = "{name}"
cell = "{cell}"

[sensor]
port = "{port}"
sample_rate_hz = {rate_hz}

[publish]
rate_hz = {publish_rate_hz}

[mqtt]
url = "{url}"

[state]
folder = "{folder}"
"""


@dataclass(frozen=True)
class State:
    """Message on the state topic, with the monotonic clock of its arrival [s]."""

    arrival_s: float
    board_time_s: float
    frames_received: int
    frames_lost: int
    crc_errors: int


@dataclass(frozen=True)
class Run:
    """Result of one run."""

    first_s: float
    """Time from the start of the service to its first estimate [s]."""
    cpu: float
    """CPU time of the service as a fraction of one core."""
    latency_s: NDArray[np.float64]
    """Time from the bytes of a sample to the reception of its estimate [s]."""
    sent: int
    """Number of frames that the board has sent."""
    last: State
    """Last received state."""


class TimedBoard(VirtualBoard):
    """Board that measures a pack under current pulses, and records when it sends.

    Attributes:
        sent_s: Monotonic time just before the bytes of each sent frame are written [s], by the number of its sample.
    """

    def __init__(self, rate_hz: int) -> None:
        block = pulses(MAX_S * rate_hz, rate_hz)
        readings = [Reading(*row) for row in zip(block["current_a"], block["voltage_v"], strict=True)]
        super().__init__(readings, rate_hz=rate_hz)
        self.sent_s: dict[int, float] = {}

    def _frame_with_fault(self, message: SampleMessage) -> bytes:
        frame = super()._frame_with_fault(message)
        self.sent_s[self.samples - 1] = time.monotonic()
        return frame


def rows() -> Iterator[Row]:
    """Measure CPU time with a board at 1,000 Hz, and latency, CPU time and start with a board at 100 Hz."""
    if MOSQUITTO is None:
        yield Row("live over a PTY", "-", "mosquitto is not installed", None)
        return
    at_1000_hz, at_100_hz = measure(1000), measure(100)
    missing = at_1000_hz.sent - at_1000_hz.last.frames_received + at_1000_hz.last.crc_errors
    yield Row(
        f"1,000 frames/s for {at_1000_hz.sent / 1000:.0f} s",
        "none lost",
        f"{missing} of {at_1000_hz.sent:,} lost",
        missing == 0,
    )
    yield Row("  service's processor time", "below 25 % of a core", f"{at_1000_hz.cpu:.1%}", at_1000_hz.cpu < 0.25)
    p50, p99, worst = np.percentile(at_100_hz.latency_s, [50, 99, 100]) * 1e3
    quantity = f"100 frames/s, byte to subscriber p50 of {at_100_hz.latency_s.size} ({PUBLISH_RATE_HZ} Hz, QoS 0)"
    bare_publish_ms = measure_bare_publish() * 1e3
    yield Row(quantity, "at most 2 x the next row", f"{p50:.2f} ms", p50 <= 2.0 * bare_publish_ms)
    yield Row(
        "  bare aiomqtt publish to subscriber p50, same payload size, QoS 1", "-", f"{bare_publish_ms:.2f} ms", None
    )
    yield Row("  p99, worst (the machine's)", "-", f"{p99:.1f} ms, {worst:.1f} ms", None)
    yield Row("  service's processor time", "at most 12 % of a core", f"{at_100_hz.cpu:.1%}", at_100_hz.cpu <= 0.12)
    yield Row(
        "warm start to first estimate received", "at most 3 s", f"{at_100_hz.first_s:.2f} s", at_100_hz.first_s <= 3.0
    )


def measure(rate_hz: int) -> Run:
    """Run board, broker, service and subscriber, and return the results."""
    folder = tempfile.TemporaryDirectory()
    with folder as path, TimedBoard(rate_hz) as board, Broker(Path(path)) as server:
        return asyncio.run(_measure(Path(path), board, rate_hz, server))


def measure_bare_publish() -> float:
    """Return the median time from a publish to its reception through the same kind of broker [s]."""
    with tempfile.TemporaryDirectory() as path, Broker(Path(path)) as server:
        return asyncio.run(_bare_publish(server))


async def _bare_publish(server: Broker) -> float:
    latency_s = []
    async with aiomqtt.Client("127.0.0.1", server.port) as receiver, aiomqtt.Client("127.0.0.1", server.port) as sender:
        await receiver.subscribe("bare", qos=0)
        for _ in range(BARE_MESSAGES):
            receiving = asyncio.create_task(anext(aiter(receiver.messages)))
            await asyncio.sleep(1.0 / PUBLISH_RATE_HZ)
            sent_s = time.monotonic()
            publishing = asyncio.create_task(sender.publish("bare", bytes(BARE_BYTES), qos=1))
            await receiving
            latency_s.append(time.monotonic() - sent_s)
            await publishing
    return float(np.median(latency_s))


def pack_file(folder: Path, name: str, port: str, rate_hz: int, server: Broker, publish_rate_hz: float) -> Path:
    """Write the settings of a pack behind the board on ``port``."""
    values = {"name": name, "cell": CELL, "port": port, "rate_hz": rate_hz, "url": server.url}
    path = folder / f"{name}.toml"
    path.write_text(PACK_TOML.format(**values, publish_rate_hz=publish_rate_hz, folder=folder))
    return path


async def _measure(folder: Path, board: TimedBoard, rate_hz: int, server: Broker) -> Run:
    pack = pack_file(folder, "bench", board.path, rate_hz, server, PUBLISH_RATE_HZ)
    states: list[State] = []
    running = asyncio.create_task(board.run_for_host())
    async with aiomqtt.Client("127.0.0.1", server.port) as client:
        await client.subscribe("bms/bench/state", qos=0)
        listening = asyncio.create_task(_listen(client, states))
        started_s = time.monotonic()
        with (folder / "log").open("w") as log:
            service = await asyncio.create_subprocess_exec(PROGRAM, "run", pack, stdout=log, stderr=log)
        try:
            await _wait_for_first(states, service, folder / "log")
            await asyncio.sleep(SETTLE_S)
            process, begin_s, received_before = psutil.Process(service.pid), time.monotonic(), len(states)
            before_s = sum(process.cpu_times()[:2])
            await asyncio.sleep(MEASURE_S)
            cpu = (sum(process.cpu_times()[:2]) - before_s) / (time.monotonic() - begin_s)
            published = states[received_before:]
            running.cancel()
            await asyncio.sleep(5.0 / PUBLISH_RATE_HZ)
        finally:
            service.send_signal(signal.SIGINT)
            await asyncio.wait_for(service.wait(), PATIENCE_S)
            listening.cancel()
    # The board sends no frame of a sample while its buffer is full, before the service reads the line.
    latency_s = np.array([s.arrival_s - board.sent_s[round(s.board_time_s * rate_hz)] for s in published])
    return Run(states[0].arrival_s - started_s, cpu, latency_s, len(board.sent_s), states[-1])


async def _listen(client: aiomqtt.Client, states: list[State]) -> None:
    async for message in client.messages:
        arrival_s = time.monotonic()
        state = json.loads(message.payload)
        names = [name for name in State.__dataclass_fields__ if name != "arrival_s"]
        states.append(State(arrival_s=arrival_s, **{name: state[name] for name in names}))


async def _wait_for_first(states: list[State], service: asyncio.subprocess.Process, log: Path) -> None:
    """Wait for the first estimate.

    Raises:
        RuntimeError: The service ended, or no estimate arrived in time.
    """
    until_s = time.monotonic() + PATIENCE_S
    while not states:
        if service.returncode is not None or time.monotonic() > until_s:
            raise RuntimeError(f"no estimate came: {(await asyncio.to_thread(log.read_text))[-2000:]}")
        await asyncio.sleep(0.02)
