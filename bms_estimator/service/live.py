"""The live loop: source -> estimator -> window -> sinks."""

import asyncio
from collections.abc import Sequence

from bms_estimator.estimator import Estimator
from bms_estimator.model.cell import CellModel
from bms_estimator.model.settings import Settings
from bms_estimator.service.source import Source
from bms_estimator.sinks import Sink


async def run_live(
    settings: Settings, cell: CellModel, *, source: Source, sinks: Sequence[Sink], stop: asyncio.Event
) -> Estimator:
    """Estimate until the source ends or ``stop`` is set.

    Args:
        settings: The pack's settings.
        cell: The pack as one object (``CellModel.pack``).
        source: Where samples come from; opened and closed here.
        sinks: Where snapshots go; opened and closed here.
        stop: Set to end cleanly.

    Returns:
        The estimator as the last sample left it.
    """
    raise NotImplementedError
