"""Recorder of captures. It never blocks the source, even if the disk is slow, hung or full."""

import asyncio
import errno
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter, read_capture
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.serial.serial_source import SerialSource
from tests.patience import LONG_S
from tests.serial_line import Line

READS = [(0.5 * i, b"3.%d,0.1\n" % i) for i in range(100)]
"""Arrival times [s] and bytes."""


class Disk:
    """Simulated disk below ``CaptureWriter``.

    Attributes:
        responds: Event. While it is cleared, writes hang.
        is_full: True: writes fail.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.responds = threading.Event()
        self.responds.set()
        self.is_full = False
        original_write = CaptureWriter.write

        def write_to_disk(writer: CaptureWriter, arrival_s: float, data: bytes) -> None:
            assert self.responds.wait(LONG_S)
            if self.is_full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            original_write(writer, arrival_s, data)

        monkeypatch.setattr(CaptureWriter, "write", write_to_disk)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    disk = Disk(monkeypatch)
    yield disk
    disk.responds.set()


def load_reads(path: Path) -> list[tuple[float, bytes]]:
    """Return the arrival times and bytes in a capture."""
    return [read for batch in read_capture(path) for read in batch]


def write_reads(recorder: CaptureRecorder) -> None:
    """Record ``READS``."""
    for read in READS:
        recorder.write(*read)


def test_hung_disk_neither_blocks_the_recorder_nor_loses_a_read(tmp_path: Path, disk: Disk) -> None:
    disk.responds.clear()
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader()) as recorder:
        write_reads(recorder)
        assert load_reads(tmp_path / "line.bms") == []
        disk.responds.set()
    assert load_reads(tmp_path / "line.bms") == READS
    assert recorder.bytes == sum(len(data) for _, data in READS)
    assert recorder.missed_reads == 0
    assert recorder.ended.exception() is None


def test_full_queue_of_a_slow_disk_ends_the_recording_and_missed_reads_are_counted(tmp_path: Path, disk: Disk) -> None:
    disk.responds.clear()
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader(), max_queued_chunks=10) as recorder:
        write_reads(recorder)
        disk.responds.set()
    saved_reads = load_reads(tmp_path / "line.bms")
    assert 10 <= len(saved_reads) <= 11  # the writer may have removed one read from the queue of ten
    assert saved_reads == READS[: len(saved_reads)]
    assert recorder.missed_reads == len(READS) - len(saved_reads)
    assert "is too slow" in str(recorder.ended.exception())


async def test_full_disk_ends_the_recording_but_not_the_samples(tmp_path: Path, disk: Disk, line: Line) -> None:
    line.plug()
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader(mode="text")) as recorder:
        settings = SensorSettings(port=str(line.path), protocol="text")
        async with SerialSource(settings, tap=recorder) as source, asyncio.timeout(LONG_S):
            while "no frame yet" not in (source.silence_reason or ""):  # noqa: ASYNC110 - the source has no event for it
                await asyncio.sleep(0.01)
            blocks = aiter(source)
            disk.is_full = True
            line.write(b"3.81,0.1\n")
            await anext(blocks)
            while not recorder.ended.done():  # noqa: ASYNC110 - another thread sets the future
                await asyncio.sleep(0.01)
            line.write(b"3.82,0.1\n")
            assert (await anext(blocks)).samples["voltage_v"].tolist() == [3.82]
            assert source.counters["missed_reads"] >= 1
    assert isinstance(error := recorder.ended.exception(), OSError)
    assert error.errno == errno.ENOSPC


def test_capture_is_synced_while_it_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, fdatasync, synced_reads = tmp_path / "line.bms", os.fdatasync, queue.SimpleQueue[int]()

    def sync_and_count(descriptor: int) -> None:
        fdatasync(descriptor)
        synced_reads.put(len(load_reads(path)))

    monkeypatch.setattr(os, "fdatasync", sync_and_count)
    with CaptureRecorder(path, CaptureHeader(), sync_s=0.02) as recorder:
        for rounds in (1, 2):
            write_reads(recorder)
            while synced_reads.get(timeout=LONG_S) < rounds * len(READS):
                pass


def test_failed_sync_ends_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", fail)
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader(), sync_s=0.02) as recorder:
        write_reads(recorder)
        assert isinstance(error := recorder.ended.exception(LONG_S), OSError)
    assert error.errno == errno.EIO


def test_hung_disk_does_not_delay_the_end_of_the_process(tmp_path: Path) -> None:
    script = """
import sys, threading
from pathlib import Path
from bms_estimator.sources.captures import raw_capture, recorder

recorder.SHUTDOWN_TIMEOUT_S = 0.01
raw_capture.CaptureWriter.write = lambda *_: threading.Event().wait()
with recorder.CaptureRecorder(Path(sys.argv[1]), raw_capture.CaptureHeader()) as recording:
    recording.write(0.0, b"3.7,0.1\\n")
print(recording.fault)
"""
    command = [sys.executable, "-c", script, tmp_path / "line.bms"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=True)
    assert "recording not ended" in process.stdout
    assert process.stdout.endswith("the disk has not answered for 0.01 s\n")
