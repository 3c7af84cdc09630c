"""HTTP listener: idle connections neither exhaust the descriptors nor keep authorized clients from being served."""

import asyncio
import contextlib
import resource
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import aiohttp
import pytest
import structlog

from bms_estimator.page.history_query import HistoryQuery
from bms_estimator.page.pack_topics import PackTopics
from bms_estimator.page.page_server import PageServer
from bms_estimator.process import listener as listener_module
from bms_estimator.process.listener import CONNECTIONS, Connections, Listener
from bms_estimator.settings.connections import PageSettings
from tests.idle_connections import DESCRIPTORS, few_descriptors, hold_idle_connections
from tests.patience import LONG_S, until


async def test_under_a_thousand_idle_connections_files_can_be_opened_and_an_authorized_client_is_answered(
    tmp_path: Path,
) -> None:
    token = tmp_path / "token"
    token.write_text("0123456789abcdef")
    settings = PageSettings(listen="127.0.0.1:0", token_file=token)
    with few_descriptors():
        async with PageServer(settings, PackTopics(), HistoryQuery(), retry=False) as server:
            await _assert_files_and_page_open_during_attack(server, tmp_path)


def _port(server: PageServer) -> int:
    return int(server.url.rsplit(":", 1)[1].strip("/"))


async def _assert_files_and_page_open_during_attack(server: PageServer, tmp_path: Path) -> None:
    async with hold_idle_connections(_port(server)):
        assert len(CONNECTIONS) <= CONNECTIONS.limit
        with (
            contextlib.ExitStack() as files
        ):  # connections may use a quarter of the descriptors, so that half of them are free
            for number in range(DESCRIPTORS // 2):
                files.enter_context((tmp_path / f"{number}").open("w"))
        headers = {"Authorization": "Bearer 0123456789abcdef"}
        async with aiohttp.ClientSession(server.url, headers=headers) as session, session.get("/") as response:
            assert response.status == 200


async def test_a_client_that_does_not_complete_the_request_header_is_disconnected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(listener_module, "HEADER_TIMEOUT_S", 0.05)
    async with PageServer(PageSettings(listen="127.0.0.1:0"), PackTopics(), HistoryQuery(), retry=False) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(b"GET / HTTP/1.1\r\nHost: loc")
        async with asyncio.timeout(LONG_S):
            with contextlib.suppress(ConnectionError):
                assert await reader.read() == b""
        writer.close()


async def test_connection_beyond_the_limit_of_its_address_displaces_the_oldest_one_without_a_request() -> None:
    connections = Connections(4)  # of these, at most two from one address
    async with contextlib.AsyncExitStack() as stack:
        first, second, third, other = [await stack.enter_async_context(accepted_connection()) for _ in range(4)]
        connections.add(*first, "192.0.2.1")
        connections.add(*second, "192.0.2.1")
        with connections.serving(first[1]):
            connections.add(*other, "192.0.2.2")
            connections.add(*third, "192.0.2.1")
            closed = [transport.is_closing() for _, transport in (first, second, third, other)]
            assert closed == [False, True, False, False]  # the first one serves a request


async def test_a_client_is_disconnected_if_it_reads_nothing_of_its_response_within_a_deadline() -> None:
    connections = Connections(2)
    own, peer = socket.socketpair()
    transport, _ = await asyncio.get_running_loop().connect_accepted_socket(asyncio.Protocol, own)
    connections.add(own, transport, "192.0.2.1")
    with connections.serving(transport):
        pass
    transport.write(bytes(8 << 20))  # more than the buffers of the sockets hold
    (open_connection,) = connections._by_transport.values()
    connections._expire(open_connection)  # the first deadline only records the unsent bytes
    unsent = transport.get_write_buffer_size()
    async with asyncio.timeout(LONG_S):
        while transport.get_write_buffer_size() == unsent:
            await asyncio.get_running_loop().run_in_executor(None, peer.recv, 1 << 16)
    connections._expire(open_connection)  # the client has read since the last deadline
    assert not transport.is_closing()
    connections._expire(open_connection)
    assert transport.is_closing()
    peer.close()


@contextlib.asynccontextmanager
async def accepted_connection() -> AsyncIterator[tuple[socket.socket, asyncio.Transport]]:
    """Return socket and transport of the server's end of a connection."""
    own, peer = socket.socketpair()
    transport, _ = await asyncio.get_running_loop().connect_accepted_socket(asyncio.Protocol, own)
    try:
        yield own, transport
    finally:
        transport.abort()
        peer.close()
        await asyncio.sleep(0)  # the loop closes the socket in its next cycle


async def test_failed_accepts_are_logged_once_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """All descriptors are in use because their limit is lowered, as if the process had leaked descriptors."""
    monkeypatch.setattr(listener_module, "ACCEPT_RETRY_S", 0.01)
    attempts, original_pause = 0, Listener._pause

    def pause(listener: Listener, listening: socket.socket) -> None:
        nonlocal attempts
        attempts += 1
        original_pause(listener, listening)

    monkeypatch.setattr(Listener, "_pause", pause)
    listener, limits = Listener(asyncio.Protocol), resource.getrlimit(resource.RLIMIT_NOFILE)
    _, hard_limit = limits
    port = await listener.open("127.0.0.1", 0)
    with structlog.testing.capture_logs() as lines, socket.socket() as client:
        client.setblocking(False)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard_limit))
        try:
            await asyncio.get_running_loop().sock_connect(client, ("127.0.0.1", port))
            await until(lambda: attempts >= 10)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    await listener.close()
    assert [line["reason"] for line in lines] == ["Too many open files"]
