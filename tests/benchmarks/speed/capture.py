"""Benchmark of the replay of a raw serial capture by the command line, including its decoding."""

import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.framing import SAMPLE_FRAME_BYTES, crc16
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter
from tests.benchmarks.load import CELL, RATE_HZ, pulses
from tests.benchmarks.table import Row
from tests.benchmarks.wire import hello, sample_frames

PROGRAM = Path(sys.executable).with_name("bms-estimator")
HOURS = (4, 16)
"""Durations of a short and a long capture [h]. The replay of the long capture must not take more memory."""
GROWTH_MIB = 16.0
"""Permitted difference of memory, which the allocator may retain [MiB]."""
RECORDS_PER_WRITE = 1_000_000
"""Number of records that are written at a time, to limit the memory."""
RECORD = np.dtype([("arrival_s", "<f8"), ("length", "<u4"), ("data", "u1", SAMPLE_FRAME_BYTES), ("crc", "<u2")])
"""Record of a raw capture that contains one frame, as a recording at 100 Hz does."""


@dataclass(frozen=True)
class Replay:
    """Result of a replay: summary and peak memory."""

    samples: int
    wall_s: float
    samples_per_s: float
    lock_lost: bool
    rss_mib: float


def rows() -> Iterator[Row]:
    """Measure the replay of the long capture, and how much more memory it takes than the replay of the short capture."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pack.raw"
        sample_counts = [hours * 3600 * RATE_HZ for hours in HOURS]
        block = pulses(sample_counts[-1])
        replays = []
        for count in sample_counts:
            path.unlink(missing_ok=True)
            write_capture(path, block[:count])
            replay(path, Path(folder), count)  # not measured: fills the disk cache and the cache of kernels
            replays.append(replay(path, Path(folder), count))
        megabytes = path.stat().st_size / 1e6
    short, long = replays
    rate = long.samples_per_s
    quantity = f"replay of {HOURS[1]} h at {RATE_HZ} Hz, {long.samples / 1e6:.2f} M samples, {megabytes:.0f} MB"
    yield Row(quantity, "at least 500,000 /s", f"{rate:,.0f} /s ({long.wall_s:.1f} s)", rate >= 5e5)
    growth_mib = long.rss_mib - short.rss_mib
    met = growth_mib <= GROWTH_MIB
    yield Row(
        f"  memory, {HOURS[0]} h and {HOURS[1]} h", "does not grow", f"{short.rss_mib:.0f}, {long.rss_mib:.0f} MiB", met
    )
    yield Row("  lock", "kept", "lost" if long.lock_lost else "kept", not long.lock_lost)


def write_capture(path: Path, block: SampleBlock) -> None:
    """Write a capture of a block with one frame in each record, received a millisecond after its sample."""
    with CaptureWriter(path, CaptureHeader()) as writer:
        writer.write(0.0, b"\0" + hello(RATE_HZ))  # the delimiter ends a frame that began before the recording
    with path.open("ab") as file:
        for first in range(0, block.size, RECORDS_PER_WRITE):
            part = block[first : first + RECORDS_PER_WRITE]
            records = np.zeros(part.size, dtype=RECORD)
            records["arrival_s"] = part["time_s"] + 1e-3
            records["length"] = SAMPLE_FRAME_BYTES
            records["data"] = sample_frames(part, first)
            _write_checksums(records.view(np.uint8).reshape(part.size, RECORD.itemsize))
            file.write(records.tobytes())


@njit(cache=True)
def _write_checksums(records):
    """Write the CRC at the end of each record; shape (n, bytes)."""
    for j in range(records.shape[0]):
        crc = crc16(records[j], 0, records.shape[1] - 2)
        records[j, -2], records[j, -1] = crc & 0xFF, crc >> 8


def replay(path: Path, folder: Path, samples: int) -> Replay:
    """Run ``bms-estimator replay``.

    Raises:
        RuntimeError: Some samples were not replayed.
    """
    rss_mib = 0.0
    with (folder / "result.json").open("w+") as result:
        process = subprocess.Popen([PROGRAM, "replay", path, "--cell", CELL, "--json"], stdout=result)
        while process.poll() is None:
            rss_mib = max(rss_mib, peak_mib(process.pid))
            time.sleep(0.05)
        result.seek(0)
        text = result.read()
    summary = json.loads(text) if process.returncode == 0 else {}
    if summary.get("samples") != samples:
        raise RuntimeError(f"{samples} samples were to be replayed, exit code {process.returncode}: {text}")
    fields = {name: summary[name] for name in ("samples", "wall_s", "samples_per_s", "lock_lost")}
    return Replay(**fields, rss_mib=rss_mib)


def peak_mib(pid: int) -> float:
    """Return the peak resident memory of a process [MiB].

    It is read from /proc, because wait4 includes the memory of the parent at the fork.
    """
    match = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return int(match[1]) / 1024 if match else 0.0
