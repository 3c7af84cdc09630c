"""Whole captures in memory, for the commands that look at all of one at once."""

from pathlib import Path

import numpy as np

from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.model.settings import SensorSettings
from bms_estimator.sources.replay import open_capture


def read_whole(path: Path, sensor: SensorSettings | None = None) -> SampleBlock:
    """All samples of a capture, dtype ``SAMPLE``.

    Raises:
        UserError: As ``open_capture``.
    """
    blocks = [block.copy() for block in open_capture(path, sensor)]
    return np.concatenate(blocks) if blocks else np.zeros(0, dtype=SAMPLE)


def name_of(path: Path) -> str:
    """What to call a capture: its file's name without the endings."""
    return path.name.split(".")[0]
