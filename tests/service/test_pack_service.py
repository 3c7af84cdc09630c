"""``run_pack_service``: what its log says before the first sample, and where the state goes."""

import asyncio
import re
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import state_folder
from bms_estimator.service.multi_pack_service import serve_several
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.settings.sensor import SensorSettings
from tests.patience import LONG_S


async def test_the_log_says_what_of_the_settings_cannot_be():
    settings = Settings(pack=PackSettings(series=14), sensor=SensorSettings(port="/dev/none"))
    stop = asyncio.Event()
    stop.set()
    with capture_logs() as lines:
        await run_pack_service(settings, load_cell("ncr18650").pack(14, 1), stop=stop)
    said = [line["reason"] for line in lines if line["event"] == "a setting that cannot be"]
    assert len(said) == 2
    assert "14 in series of 3 Ah" in said[0]
    assert "the board's range ends at 25.0 V" in said[1]


@pytest.mark.parametrize(
    ("names", "ports", "mqtt", "said"),
    [
        (("a", "a"), ("/dev/one", "/dev/two"), {}, "pack.name = a: 2 of the packs have it; give each its own"),
        (("a", "b"), ("/dev/one", "/dev/one"), {}, "sensor.port = /dev/one: 2 of the packs have it; give each its own"),
        (
            ("a", "b"),
            ("/dev/one", "/dev/two"),
            {"username": "b", "password_file": "/none"},
            "b: mqtt.password_file = /none: cannot be read",
        ),
    ],
)
async def test_one_of_several_packs_that_cannot_be_served_is_named(
    names: tuple[str, str], ports: tuple[str, str], mqtt: dict[str, str], said: str, state_home: Path
) -> None:
    cell, packs = load_cell("chen_mora"), []
    for name, port in zip(names, ports, strict=True):
        tables = {"pack": {"name": name}, "sensor": {"port": port}} | ({"mqtt": mqtt} if mqtt and name == "b" else {})
        packs.append((Settings.model_validate(tables), cell))
    with pytest.raises(UserError, match=f"^{re.escape(said)}"):
        await asyncio.wait_for(serve_several(packs), LONG_S)


async def test_packs_without_a_serial_line_need_no_port_of_their_own(state_home: Path) -> None:
    source = {"kind": "mqtt", "profile": "opendtu", "url": "mqtt://localhost"}
    sources = {"a": source, "b": source | {"password_file": "/none"}}
    tables = [{"pack": {"name": name}, "source": table} for name, table in sources.items()]
    packs = [(Settings.model_validate(table), load_cell("chen_mora")) for table in tables]
    with pytest.raises(UserError, match=r"^b: source.password_file = /none: cannot be read"):
        await asyncio.wait_for(serve_several(packs), LONG_S)


def test_a_user_without_a_home_is_served_and_told_that_the_state_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setenv("HOME", "~")
    with capture_logs() as lines:
        state_folder(Settings())
    assert [line["event"] for line in lines] == ["the state will be lost at a restart"]
