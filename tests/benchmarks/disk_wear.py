"""Bytes that the service of one pack writes to its disk in an hour: at rest, under load, and with a flapping alarm.

Three services read frames of boards from pseudo-terminals in real time. ``write_bytes`` of ``/proc/PID/io`` counts the pages
that a process makes the kernel write. The folder must be on a disk, because the kernel does not count pages of a tmpfs.

python -m tests.benchmarks.disk_wear --minutes 18
"""

import argparse
import asyncio
import os
import sys
import tempfile
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.model.arrays import SAMPLE, Floats
from bms_estimator.model.cell import load_cell
from tests.benchmarks.load import CELL, CURRENT_STEP_A, VOLTAGE_STEP_V
from tests.benchmarks.table import Row, show
from tests.benchmarks.wire import hello, sample_frames
from tests.mosquitto import Broker, Listener

RATE_HZ = 10
"""Sample rate [Hz]."""
BURST_S = 0.5
"""Interval at which a board sends its frames [s]."""
WARM_S = 60.0
"""Time after the first sample before bytes are counted [s], because the start creates files."""
HALF_CYCLE_S = 1800.0
"""Duration of a discharge at 1 C, and of the charge after it [s]."""
FLAP_S = 1.0
"""Time for which the current stays above, and then below, the limit of the flapping alarm [s]."""
PACK_TOML = """
[pack]
name = "{name}"
cell = "{cell}"
[sensor]
port = "{port}"
sample_rate_hz = {rate_hz}
[mqtt]
url = "{url}"
[state]
folder = "{folder}"
[alarms]
discharge_over_current = {{limit_a = {limit_a}, clear_a = {limit_a}, delay_s = 0, clear_delay_s = 0, latch = false}}
"""


class Case(NamedTuple):
    """Current of a pack, and the accepted wear."""

    name: str
    what: str
    max_mb_h: float
    """Limit of the bytes written in an hour [MB/h]."""
    limit_a: float
    """Limit of ``discharge_over_current`` [A]."""

    def current_a(self, time_s: Floats) -> Floats:
        """Return the current at each time [A], positive on discharge."""
        capacity_ah = load_cell(CELL).cell.capacity_ah
        if self.name == "load":
            return np.where(time_s % (2.0 * HALF_CYCLE_S) < HALF_CYCLE_S, capacity_ah, -capacity_ah)
        return np.where((self.name == "flap") & (time_s % (2.0 * FLAP_S) < FLAP_S), 1.0, 0.0)


CASES = (
    Case("rest", "at rest", 5.0, 100.0),
    Case("load", "under a load of 1 C", 5.0, 100.0),
    Case("flap", f"with an alarm that is raised every {2.0 * FLAP_S:g} s", 10.0, 0.5),
)
"""Measured cases. The limit at rest is that under load."""


def frames(case: Case, seconds: float) -> list[bytes]:
    """Return the frames of the board of a pack, one element for each ``BURST_S``."""
    cell, samples = load_cell(CELL), round(RATE_HZ * seconds)
    block = np.zeros(samples, SAMPLE)
    block["time_s"] = time_s = np.arange(samples) / RATE_HZ
    current_a = case.current_a(time_s)
    voltage_v, _ = simulate_cell((0.9, 0.0, 0.0), time_s, current_a, cell.cell.capacity_ah * 3600.0, cell.a)
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, (2, samples))
    block["current_a"] = current_a + noise[0] * CURRENT_STEP_A
    block["voltage_v"] = voltage_v + noise[1] * VOLTAGE_STEP_V
    encoded, burst = sample_frames(block), round(RATE_HZ * BURST_S)
    return [encoded[i : i + burst].tobytes() for i in range(0, samples, burst)]


async def measure(case: Case, seconds: float, folder: Path, broker: Broker) -> float:
    """Run the service of a pack; return the bytes that it writes in an hour [MB/h]."""
    master, slave = os.openpty()
    tty.setraw(slave)
    pack = folder / f"{case.name}.toml"
    pack.write_text(
        PACK_TOML.format(
            name=case.name,
            cell=CELL,
            port=os.ttyname(slave),
            rate_hz=RATE_HZ,
            url=broker.url,
            folder=folder / "state",
            limit_a=case.limit_a,
        )
    )
    program = Path(sys.executable).with_name("bms-estimator")
    loop, null = asyncio.get_running_loop(), asyncio.subprocess.DEVNULL
    async with Listener(broker) as live:
        service = await asyncio.create_subprocess_exec(program, "run", "--no-view", pack, stdout=null, stderr=null)
        try:
            topic = f"bms/{case.name}/health"
            await live.wait_json(topic, lambda h: "no frame yet" in (h["sensor_message"] or ""))
            os.write(master, b"\0" + hello(RATE_HZ))
            started_s, before = loop.time(), 0
            bursts = frames(case, WARM_S + seconds)
            for i, burst in enumerate(bursts):
                await asyncio.sleep(max(started_s + i * BURST_S - loop.time(), 0.0))
                os.write(master, burst)
                live.messages.clear()  # they would fill the memory
                if i == round(WARM_S / BURST_S):
                    before = _written_bytes(service.pid)
            return (_written_bytes(service.pid) - before) / seconds * 3600.0 / 1e6
        finally:
            service.kill()
            await service.wait()
            os.close(slave)
            os.close(master)


def _written_bytes(pid: int) -> int:
    """Return the bytes that a process has made the kernel write."""
    lines = Path(f"/proc/{pid}/io").read_text().splitlines()
    return int(dict(line.split(": ") for line in lines)["write_bytes"])


async def measure_all(seconds: float) -> list[float]:
    """Measure all cases at the same time."""
    with tempfile.TemporaryDirectory(dir=Path.home() / ".cache") as folder, Broker(Path(folder)) as broker:
        return await asyncio.gather(*(measure(case, seconds, Path(folder), broker) for case in CASES))


def rows(minutes: float) -> Iterator[Row]:
    """Measure; yield a row for each case."""
    for case, mb_h in zip(CASES, asyncio.run(measure_all(60.0 * minutes)), strict=True):
        target = f"at most {case.max_mb_h:g} MB/h"
        yield Row(f"written {case.what}", target, f"{mb_h:.1f} MB/h", mb_h <= case.max_mb_h)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=18.0)
    options = parser.parse_args()
    title = f"writes of one pack to its disk in {options.minutes:g} min, by /proc/PID/io"
    sys.exit(not show(rows(options.minutes), title))


if __name__ == "__main__":
    main()
