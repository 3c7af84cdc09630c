"""Steps of the setup on a page."""

import asyncio
import socket

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.setup import new_pack
from bms_estimator.setup.answers import Answers
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.found_device import FoundDevice
from bms_estimator.setup.new_pack import create_pack
from bms_estimator.setup.page import session as session_module
from bms_estimator.setup.page.session import SetupSession

DEVICE = FoundDevice("/dev/none", "JK-BMS", {"sensor": {"port": "/dev/none", "protocol": "jk"}}, capacity_ah=280.0)


def test_invalid_settings_leave_no_file(tmp_path):
    answers = Answers(DEVICE, None, "house", "lfp", 100.0, 8, 1, broker=BrokerLogin("mqtt://localhost:99999"))
    with pytest.raises(UserError, match="Port out of range"):
        create_pack(tmp_path / "pack.toml", answers)
    assert not list(tmp_path.iterdir())


def test_another_capacity_than_that_of_the_device_is_a_warning(tmp_path):
    answers = [Answers(DEVICE, None, f"pack{ah:g}", "lfp", ah, 8, 2) for ah in (140.0, 50.0)]
    same, other = (create_pack(tmp_path / f"{each.name}.toml", each).warnings for each in answers)
    text = "pack.capacity_ah: the pack has 100 Ah, but its device reports 280 Ah"
    assert [text in warnings for warnings in (same, other)] == [False, True]


def test_the_page_of_a_second_pack_gets_another_port(tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as first_page:
        port = first_page.getsockname()[1]
        monkeypatch.setattr(new_pack, "DEFAULT_LISTEN", f"127.0.0.1:{port}")
        files = {setup_port: tmp_path / f"pack{setup_port}.toml" for setup_port in (0, port)}
        packs = [create_pack(file, Answers(DEVICE, None, "house", "lfp", 100.0, 8, 1), n) for n, file in files.items()]
    assert packs[0].settings.page.address.port > port  # the next port that is free
    assert packs[1].settings.page.address.port == port  # that of the setup page, which ends


async def test_a_second_search_ends_the_first(tmp_path, monkeypatch):
    ended = []

    async def search(places):
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(places)

    monkeypatch.setattr(session_module, "search", search)
    session = SetupSession(tmp_path / "pack.toml", print)
    for place in ("mqtt://first", "mqtt://second"):
        session.start_search([place])
        await asyncio.sleep(0)
    assert ended == [["mqtt://first"]]
    await session.close()
