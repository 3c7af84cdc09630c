"""``serve``: what its log says before the first sample, and where the state goes."""

import asyncio

import pytest
from structlog.testing import capture_logs

from bms_estimator.model.cell import load_cell
from bms_estimator.model.settings import PackSettings, SensorSettings, Settings
from bms_estimator.service.serve import serve, state_folder


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


def test_a_user_without_a_home_is_served_and_told_that_the_state_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setenv("HOME", "~")
    with capture_logs() as lines:
        state_folder(Settings())
    assert [line["event"] for line in lines] == ["the state cannot outlive a restart"]
