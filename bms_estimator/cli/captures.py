"""Whole captures in memory, for the commands that look at all of one at once."""

import asyncio
from pathlib import Path

import numpy as np

from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import SensorSettings
from bms_estimator.sources.replay import open_capture


def read_whole(path: Path, sensor: SensorSettings | None = None) -> SampleBlock:
    """All samples of a capture, dtype ``SAMPLE``.

    Raises:
        UserError: As ``open_capture``.
    """
    return asyncio.run(_collect(path, sensor or SensorSettings()))


async def _collect(path: Path, sensor: SensorSettings) -> SampleBlock:
    async with open_capture(path, sensor) as source:
        blocks = [block.copy() async for block in source]
    return np.concatenate(blocks)


def name_of(path: Path) -> str:
    """What to call a capture: its file's name without the endings."""
    return path.name.split(".")[0]
