"""Recorder with slow, hung and full disks. It never blocks the source."""

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


class Disk:
    """Simulated disk below ``CaptureWriter``.

    Attributes:
        works: Event; while it is cleared, writes hang.
        fails: True: writes fail because the disk is full.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.works = threading.Event()
        self.works.set()
        self.fails = False
        write = CaptureWriter.write

        def write_to_disk(writer: CaptureWriter, arrival_s: float, data: bytes) -> None:
            assert self.works.wait(LONG_S)
            if self.fails:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write(writer, arrival_s, data)

        monkeypatch.setattr(CaptureWriter, "write", write_to_disk)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    disk = Disk(monkeypatch)
    yield disk
    disk.works.set()


def read_reads(path: Path) -> list[tuple[float, bytes]]:
    """Return the arrival times and bytes in a capture."""
    return [read for batch in read_capture(path) for read in batch]


def write_reads(recording: CaptureRecorder) -> None:
    for read in READS:
        recording.write(*read)


def test_hung_disk_blocks_no_writer_and_loses_nothing(tmp_path: Path, disk: Disk) -> None:
    disk.works.clear()
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader()) as recording:
        write_reads(recording)
        assert read_reads(tmp_path / "line.bms") == []
        disk.works.set()
    assert read_reads(tmp_path / "line.bms") == READS
    assert recording.bytes == sum(len(data) for _, data in READS)
    assert recording.missed_reads == 0
    assert recording.ended.exception() is None


def test_slow_disk_ends_the_recording_and_missed_reads_are_counted(tmp_path: Path, disk: Disk) -> None:
    disk.works.clear()
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader(), max_queued_chunks=10) as recording:
        write_reads(recording)
        disk.works.set()
    saved_reads = read_reads(tmp_path / "line.bms")
    assert 10 <= len(saved_reads) <= 11  # the writer may have removed one read from the queue of ten
    assert saved_reads == READS[: len(saved_reads)]
    assert recording.missed_reads == len(READS) - len(saved_reads)
    assert "is too slow" in str(recording.ended.exception())


async def test_full_disk_ends_the_recording_but_not_the_samples(tmp_path: Path, disk: Disk, line: Line) -> None:
    line.plug()
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader(mode="text")) as recording:
        settings = SensorSettings(port=str(line.path), protocol="text")
        async with SerialSource(settings, tap=recording) as source, asyncio.timeout(LONG_S):
            while "no frame yet" not in (source.silence_reason or ""):  # noqa: ASYNC110 - the source has no event for it
                await asyncio.sleep(0.01)
            blocks = aiter(source)
            disk.fails = True
            line.write(b"3.81,0.1\n")
            await anext(blocks)
            while not recording.ended.done():  # noqa: ASYNC110 - another thread sets the future
                await asyncio.sleep(0.01)
            line.write(b"3.82,0.1\n")
            assert (await anext(blocks)).samples["voltage_v"].tolist() == [3.82]
            assert source.counters["missed_reads"] >= 1
    assert isinstance(error := recording.ended.exception(), OSError)
    assert error.errno == errno.ENOSPC


def test_capture_is_synced_while_it_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, fdatasync, synced_reads = tmp_path / "line.bms", os.fdatasync, queue.SimpleQueue[int]()

    def watched(descriptor: int) -> None:
        fdatasync(descriptor)
        synced_reads.put(len(read_reads(path)))

    monkeypatch.setattr(os, "fdatasync", watched)
    with CaptureRecorder(path, CaptureHeader(), sync_s=0.02) as recording:
        for times in (1, 2):
            write_reads(recording)
            while synced_reads.get(timeout=LONG_S) < times * len(READS):
                pass


def test_failed_sync_ends_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", fails)
    with CaptureRecorder(tmp_path / "line.bms", CaptureHeader(), sync_s=0.02) as recording:
        write_reads(recording)
        assert isinstance(error := recording.ended.exception(LONG_S), OSError)
    assert error.errno == errno.EIO


def test_hung_disk_does_not_delay_the_end_of_the_process(tmp_path: Path) -> None:
    script = """
import sys, threading
from pathlib import Path
from bms_estimator.sources.captures import raw_capture, recorder

recorder.SHUTDOWN_TIMEOUT_S = 0.01
raw_capture.CaptureWriter.write = lambda *_: threading.Event().wait()
with recorder.CaptureRecorder(Path(sys.argv[1]), raw_capture.CaptureHeader()) as recorded:
    recorded.write(0.0, b"3.7,0.1\\n")
print(recorded.fault)
"""
    command = [sys.executable, "-c", script, tmp_path / "line.bms"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=True)
    assert "recording not ended" in ended.stdout
    assert ended.stdout.endswith("the disk has not answered for 0.01 s\n")
