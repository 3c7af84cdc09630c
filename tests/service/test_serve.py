"""``serve``: what its log says before the first sample."""

import asyncio

from structlog.testing import capture_logs

from bms_estimator.model.cell import load_cell
from bms_estimator.model.settings import PackSettings, SensorSettings, Settings
from bms_estimator.service.serve import serve


async def test_the_log_says_what_of_the_settings_cannot_be():
    settings = Settings(pack=PackSettings(series=14), sensor=SensorSettings(port="/dev/none"))
    stop = asyncio.Event()
    stop.set()
    with capture_logs() as lines:
        await serve(settings, load_cell("ncr18650").pack(14, 1), stop=stop)
    said = [line["reason"] for line in lines if line["event"] == "a setting that cannot be"]
    assert len(said) == 2
    assert "14 in series of 3 Ah" in said[0]
    assert "the board's range ends at 25.0 V" in said[1]
