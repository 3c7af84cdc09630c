"""Connection of a fleet service to a real server with a wrong certificate, one that does not read, or a killed one."""

import asyncio
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from bms_estimator.fleet.nats import connection
from bms_estimator.fleet.nats.connection import close, connect
from bms_estimator.fleet.server.nats_config import Tls
from tests.fleet.nats_cluster import running
from tests.mqtt.certificates import Authority
from tests.patience import LONG_S

BUFFERS_BYTES = 16 << 20
"""More than the capacity of all buffers between client and server [bytes]."""


class Links:
    """Link changes reported by ``connect``."""

    def __init__(self) -> None:
        self._changes = asyncio.Queue[str | None]()

    def __call__(self, reason: str | None) -> None:
        self._changes.put_nowait(reason)

    async def until(self, wanted: str | None) -> None:
        """Wait for a reason with this beginning, or (None) for a restored connection."""
        async with asyncio.timeout(LONG_S):
            while True:
                reason = await self._changes.get()
                if reason is wanted or (reason and wanted and reason.startswith(wanted)):
                    return


def signed_by(authority: Authority) -> Tls:
    certificate, key = authority.sign("node")
    return Tls(certificate, key)


async def test_waiting_client_connects_once_the_certificate_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "CLOSE_TIMEOUT_S", 0.2)
    for name in ("ours", "other"):
        (tmp_path / name).mkdir()
    ours, other = Authority(tmp_path / "ours"), Authority(tmp_path / "other")
    links = Links()
    with running(tmp_path, tls=signed_by(other)) as cluster:
        url = f"tls://{cluster.nodes[0].nats}"
        connecting = asyncio.create_task(connect(url, "x", ca=ours.certificate, on_link_change=links))
        for _ in range(3):
            await links.until("the server's certificate is not trusted")
        cluster.kill(0)
        cluster.nodes = [replace(cluster.nodes[0], tls=signed_by(ours))]
        cluster.start(0)
        async with asyncio.timeout(LONG_S):
            nc = await connecting
        assert nc.is_connected
        await close(nc)


async def test_reconnects_to_a_server_that_stopped_reading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "PING_S", 1)
    links = Links()
    with running(tmp_path) as cluster:
        nc = await connect(cluster.url, "x", on_link_change=links)
        os.kill(cluster.pid(0), signal.SIGSTOP)
        publishing = asyncio.create_task(_publish(nc, BUFFERS_BYTES))
        await links.until("the connection is lost")
        os.kill(cluster.pid(0), signal.SIGCONT)
        await links.until(None)
        publishing.cancel()
        await asyncio.wait([publishing])
        await nc.flush()
        await close(nc)
        assert nc.is_closed


async def test_closes_with_unsent_messages_after_the_server_was_killed(tmp_path: Path) -> None:
    links = Links()
    with running(tmp_path) as cluster:
        nc = await connect(cluster.url, "x", on_link_change=links)
        cluster.kill(0)
        await links.until("the connection is lost")
        await nc.publish("a.b", b"c")
        await close(nc)
        assert nc.is_closed


async def _publish(nc, size: int) -> None:
    for _ in range(size >> 16):
        await nc.publish("a.b", bytes(1 << 16))
