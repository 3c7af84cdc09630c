"""Connection of a fleet service to a real server that has a wrong certificate, stops reading, or is killed."""

import asyncio
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from bms_estimator.fleet.nats import connection
from bms_estimator.fleet.nats.connection import close, connect, run_connected
from bms_estimator.fleet.server.nats_config import Tls
from bms_estimator.process.runtime import end_tasks
from tests.fleet.nats_cluster import running
from tests.mqtt.certificates import Authority
from tests.patience import LONG_S

BUFFERS_BYTES = 16 << 20
"""Size of messages that exceeds the capacity of all buffers between client and server [bytes]."""


class LinkChanges:
    """Changes of the connection that ``connect`` reports."""

    def __init__(self) -> None:
        self._changes = asyncio.Queue[str | None]()

    def __call__(self, reason: str | None) -> None:
        self._changes.put_nowait(reason)

    async def until(self, wanted: str | None) -> None:
        """Wait for a loss whose reason begins with ``wanted``; None: wait for a restored connection."""
        async with asyncio.timeout(LONG_S):
            while True:
                reason = await self._changes.get()
                if reason is wanted or (reason and wanted and reason.startswith(wanted)):
                    return


def signed_by(authority: Authority) -> Tls:
    """Return a certificate for the server, signed by an authority."""
    certificate, key = authority.sign("node")
    return Tls(certificate, key)


async def test_client_retries_and_connects_once_the_server_has_a_trusted_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "CLOSE_TIMEOUT_S", 0.2)
    for name in ("trusted", "other"):
        (tmp_path / name).mkdir()
    trusted, other = Authority(tmp_path / "trusted"), Authority(tmp_path / "other")
    changes = LinkChanges()
    with running(tmp_path, tls=signed_by(other)) as cluster:
        url = f"tls://{cluster.nodes[0].nats}"
        connecting = asyncio.create_task(connect(url, "x", ca=trusted.certificate, on_link_change=changes))
        for _ in range(3):
            await changes.until("the server's certificate is not trusted")
        cluster.kill(0)
        cluster.nodes = [replace(cluster.nodes[0], tls=signed_by(trusted))]
        cluster.start(0)
        async with asyncio.timeout(LONG_S):
            nc = await connecting
        assert nc.is_connected
        await close(nc)


async def test_client_reconnects_to_a_server_that_stopped_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "PING_S", 1)
    changes = LinkChanges()
    with running(tmp_path) as cluster:
        nc = await connect(cluster.url, "x", on_link_change=changes)
        os.kill(cluster.pid(0), signal.SIGSTOP)
        publishing = asyncio.create_task(_publish(nc, BUFFERS_BYTES))
        await changes.until("the connection is lost")
        os.kill(cluster.pid(0), signal.SIGCONT)
        await changes.until(None)
        publishing.cancel()
        await asyncio.wait([publishing])
        await nc.flush()
        await close(nc)
        assert nc.is_closed


async def test_client_with_unsent_messages_can_be_closed_after_the_server_was_killed(tmp_path: Path) -> None:
    changes = LinkChanges()
    with running(tmp_path) as cluster:
        nc = await connect(cluster.url, "x", on_link_change=changes)
        cluster.kill(0)
        await changes.until("the connection is lost")
        await nc.publish("a.b", b"c")
        await close(nc)
        assert nc.is_closed


async def test_cancelled_connecting_closes_the_socket() -> None:
    accepted, closed = asyncio.Event(), asyncio.Event()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        accepted.set()  # without the server's greeting, for which the client waits
        await reader.read()
        closed.set()
        writer.close()

    async with await asyncio.start_server(accept, "127.0.0.1", 0) as server:
        connecting = asyncio.create_task(connect(f"nats://127.0.0.1:{server.sockets[0].getsockname()[1]}", "x"))
        await accepted.wait()
        async with asyncio.timeout(LONG_S):
            await end_tasks(connecting)
            await closed.wait()


async def _publish(nc, total_bytes: int) -> None:
    message = bytes(1 << 16)
    for _ in range(total_bytes // len(message)):
        await nc.publish("a.b", message)


async def test_service_that_is_stopped_before_a_server_is_found_ends() -> None:
    stop = asyncio.Event()
    asyncio.get_running_loop().call_soon(stop.set)
    await asyncio.wait_for(run_connected(close, stop, connect("nats://127.0.0.1:1", "w")), LONG_S)
