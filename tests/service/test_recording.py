"""A recording beside the estimate reaches the disk while it grows."""

import asyncio
import os
import signal
from pathlib import Path

import pytest

from bms_estimator.cli import run
from bms_estimator.model.cell import load_cell
from bms_estimator.model.settings import SensorSettings, Settings
from bms_estimator.sources.raw_capture import CaptureWriter, header_of
from tests.patience import LONG_S
from tests.serial_line import Line


@pytest.mark.parametrize("fails", [False, True])
async def test_the_disk_takes_what_is_recorded_while_it_grows_and_one_that_fails_does_not_end_the_estimate(
    tmp_path: Path, line: Line, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    sizes, enough = [], asyncio.Event()
    loop, fdatasync = asyncio.get_running_loop(), os.fdatasync

    def watched(descriptor: int) -> None:
        fdatasync(descriptor)
        sizes.append(os.fstat(descriptor).st_size)
        if fails or sizes[-1] > sizes[0]:
            loop.call_soon_threadsafe(enough.set)
        if fails:
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(run, "SYNC_S", 0.02)
    monkeypatch.setattr(os, "fdatasync", watched)
    line.plug()
    settings = Settings(sensor=SensorSettings(port=str(line.path), protocol="text"))
    writer = CaptureWriter(tmp_path / "line.bms", header_of(settings.sensor))
    serving = asyncio.create_task(run.serve_and_record(settings, load_cell("chen_mora"), [], writer))
    async with asyncio.timeout(LONG_S):
        while not enough.is_set():
            line.write(b"3.80,0.10,25.0\r\n")
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.1)
        assert not serving.done()
        os.kill(os.getpid(), signal.SIGTERM)
        await serving
    monkeypatch.undo()
    writer.close()
