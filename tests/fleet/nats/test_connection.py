"""Connections of a fleet's services to a real server that shows a wrong certificate, reads nothing, or is gone."""

import asyncio
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from bms_estimator.fleet.nats import connection
from bms_estimator.fleet.nats.connection import connect, part
from bms_estimator.fleet.server.nats_config import Tls
from tests.fleet.engine import running
from tests.mqtt.certificates import Authority
from tests.patience import LONG_S

TOO_MUCH = 16 << 20
"""More than all buffers between us and the server hold."""


class Links:
    """What ``connect`` says of the connection."""

    def __init__(self) -> None:
        self._said = asyncio.Queue[str | None]()

    def __call__(self, trouble: str | None) -> None:
        self._said.put_nowait(trouble)

    async def until(self, wanted: str | None) -> None:
        """What begins so, or that there is a connection."""
        async with asyncio.timeout(LONG_S):
            while True:
                said = await self._said.get()
                if said is wanted or (said and wanted and said.startswith(wanted)):
                    return


def signed_by(authority: Authority) -> Tls:
    certificate, key = authority.sign("node")
    return Tls(certificate, key)


async def test_a_certificate_that_is_mended_lets_in_who_has_waited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "CLOSING_S", 0.2)
    for name in ("ours", "other"):
        (tmp_path / name).mkdir()
    ours, other = Authority(tmp_path / "ours"), Authority(tmp_path / "other")
    said = Links()
    with running(tmp_path, tls=signed_by(other)) as engine:
        where = f"tls://{engine.nodes[0].nats}"
        connecting = asyncio.create_task(connect(where, "x", ca=ours.certificate, linked=said))
        for _ in range(3):
            await said.until("its certificate is of nobody whom we trust")
        engine.kill(0)
        engine.nodes = [replace(engine.nodes[0], tls=signed_by(ours))]
        engine.start(0)
        async with asyncio.timeout(LONG_S):
            nc = await connecting
        assert nc.is_connected
        await part(nc)


async def test_a_server_that_reads_nothing_is_left_and_come_back_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "PING_S", 1)
    said = Links()
    with running(tmp_path) as engine:
        nc = await connect(engine.url, "x", linked=said)
        os.kill(engine.pid(0), signal.SIGSTOP)
        saying = asyncio.create_task(_say(nc, TOO_MUCH))
        await said.until("the server is lost")
        os.kill(engine.pid(0), signal.SIGCONT)
        await said.until(None)
        saying.cancel()
        await asyncio.wait([saying])
        await nc.flush()
        await part(nc)
        assert nc.is_closed


async def test_a_connection_is_parted_from_though_the_server_is_gone_and_something_waits(tmp_path: Path) -> None:
    said = Links()
    with running(tmp_path) as engine:
        nc = await connect(engine.url, "x", linked=said)
        engine.kill(0)
        await said.until("the server is lost")
        await nc.publish("a.b", b"c")
        await part(nc)
        assert nc.is_closed


async def _say(nc, size: int) -> None:
    for _ in range(size >> 16):
        await nc.publish("a.b", bytes(1 << 16))
