"""Steps of the setup on a page."""

import asyncio

from bms_estimator.setup.page import session as session_module
from bms_estimator.setup.page.session import SetupSession


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
