"""Page server over real sockets: files, stream, token, history, and an address in use."""

import asyncio
import contextlib
import json
import re
import socket
from collections.abc import AsyncIterator

import aiohttp
import psutil
import pytest
from yarl import URL

from bms_estimator.model.errors import UserError
from bms_estimator.page import web_server
from bms_estimator.page.history_query import HistoryQuery
from bms_estimator.page.pack_topics import PackTopics
from bms_estimator.page.page_server import FILES, STATIC, PageServer
from bms_estimator.page.page_sink import Pages, PageSink
from bms_estimator.process import listener
from bms_estimator.settings.connections import PageSettings
from bms_estimator.store.history import epoch_s
from tests.patience import LONG_S
from tests.sinks.snapshots import CELL_SNAPSHOT
from tests.store.test_history import record_history, snapshot_at

MAX_STATIC_BYTES = 119_000
"""Maximum total size of the static files [bytes]."""
TOKEN = "0123456789abcdef"


@pytest.fixture
def hub() -> PackTopics:
    return PackTopics()


@pytest.fixture
def history() -> HistoryQuery:
    return HistoryQuery()


@contextlib.asynccontextmanager
async def browsing(
    hub: PackTopics, history: HistoryQuery, settings: PageSettings | None = None
) -> AsyncIterator[aiohttp.ClientSession]:
    """Start a server. Yield a client with cookies for its address."""
    jar = aiohttp.CookieJar(unsafe=True)  # accepts cookies of an IP address
    async with (
        PageServer(settings or PageSettings(listen="127.0.0.1:0"), hub, history, retry=False) as server,
        aiohttp.ClientSession(server.url, cookie_jar=jar) as session,
    ):
        yield session


async def stream_messages(response: aiohttp.ClientResponse) -> AsyncIterator[dict[str, object]]:
    """Yield the messages of an event stream."""
    async for line in response.content:
        if line.startswith(b"data: "):
            yield json.loads(line[6:])


def test_static_files_are_small_and_name_no_other_server():
    paths = [file.path for file in FILES.values()]
    assert sorted(paths) == sorted(STATIC.iterdir())
    assert sum(path.stat().st_size for path in paths) <= MAX_STATIC_BYTES
    own_texts = [path.read_text() for path in paths if path.name != "uplot.js"]  # that library names its site
    for text in own_texts:
        assert not re.search(r"https?://", text.replace("http://www.w3.org/2000/svg", ""))


async def test_files_have_media_type_security_headers_and_etag(hub, history):
    async with browsing(hub, history) as session:
        for path, (file, media_type) in FILES.items():
            async with session.get(path) as response:
                assert (response.status, response.content_type) == (200, media_type)
                assert await response.read() == file.read_bytes()
                assert "default-src 'none'" in response.headers["Content-Security-Policy"]
                assert response.headers["X-Content-Type-Options"] == "nosniff"
            async with session.get(path, headers={"If-None-Match": response.headers["ETag"]}) as again:
                assert again.status == 304
        for path in ("/../hub.py", "/static/index.html", "/x"):
            async with session.get(path) as response:
                assert response.status == 404
        async with session.post("/") as response:
            assert response.status == 405


async def test_reader_gets_stored_and_then_new_values(hub, history):
    hub.put("attic", "availability", "online")
    async with browsing(hub, history) as session, session.get("/events") as response:
        assert response.content_type == "text/event-stream"
        stream = stream_messages(response)
        assert (await anext(stream))["attic/availability"] == "online"
        hub.put("attic", "state", {"time": "2026-11-22T16:00:00Z", "soc": 0.5})
        assert (await anext(stream)) == {"attic/state": {"time": "2026-11-22T16:00:00Z", "soc": 0.5}}


async def test_empty_messages_are_sent_so_that_a_lost_connection_is_noticed(hub, history, monkeypatch):
    monkeypatch.setattr(web_server, "PING_S", 0.05)
    async with browsing(hub, history) as session, session.get("/events") as response:
        stream = stream_messages(response)
        assert [await anext(stream) for _ in range(3)] == [{}, {}, {}]


async def test_client_that_reads_nothing_is_disconnected(hub, history, monkeypatch):
    monkeypatch.setattr(web_server, "WRITE_S", 0.2)
    async with browsing(hub, history) as session:
        reader, writer = await asyncio.open_connection(session._base_url.host, session._base_url.port, limit=1024)
        writer.write(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        async with asyncio.timeout(LONG_S):
            await reader.readuntil(b"retry")
            payload = {"text": "x" * 60_000}
            while hub.readers:  # the first messages fill the buffers of the sockets
                hub.put("attic", "health", payload)
                assert all(len(reader._waiting) <= 4 for reader in hub._readers)
                await asyncio.sleep(0)
        writer.close()


async def test_stream_beyond_the_limit_replaces_the_oldest_one_of_the_address_with_most_streams(
    hub: PackTopics, history: HistoryQuery, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web_server, "MAX_STREAMS", 3)
    hub.set_link_state(None)
    async with browsing(hub, history) as session, contextlib.AsyncExitStack() as streams:
        url = session._base_url.join(URL("/events"))

        async def open_stream(address: str) -> AsyncIterator[dict[str, object]]:
            connector = aiohttp.TCPConnector(local_addr=(address, 0))
            client = await streams.enter_async_context(aiohttp.ClientSession(connector=connector))
            stream = stream_messages(await streams.enter_async_context(client.get(url)))
            assert "link" in await anext(stream)
            return stream

        first, second, third = [await open_stream("127.0.0.2") for _ in range(3)]
        other = await open_stream("127.0.0.3")
        with pytest.raises(aiohttp.ClientError):
            await anext(first)
        fourth = await open_stream("127.0.0.2")
        with pytest.raises(aiohttp.ClientError):
            await anext(second)
        hub.put("attic", "availability", "online")
        for stream in (third, other, fourth):
            assert "attic/availability" in await anext(stream)


async def test_readers_that_do_not_read_share_the_memory_of_their_messages(
    hub: PackTopics, history: HistoryQuery
) -> None:
    for number in range(256):
        hub.put("attic", f"alarm/{number}", f"{number}".zfill(65_000))
    process = psutil.Process()
    async with browsing(hub, history) as session:
        before_bytes = process.memory_info().rss
        address = session._base_url.host, session._base_url.port
        clients = [await asyncio.open_connection(*address, limit=1024) for _ in range(web_server.MAX_STREAMS)]
        async with asyncio.timeout(LONG_S):
            for reader, writer in clients:
                writer.write(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
                await reader.readuntil(b"data: ")
            for number in range(256):  # new texts replace the first ones, which no reader may store
                hub.put("attic", f"alarm/{number}", f"{number}".zfill(65_001))
                await asyncio.sleep(0)
        grown_bytes = process.memory_info().rss - before_bytes
        for _, writer in clients:
            writer.close()
    assert grown_bytes < 100e6, f"{grown_bytes / 1e6:.0f} MB"  # the texts have 17 MB


async def test_foreign_host_name_is_rejected(hub, history):
    async with browsing(hub, history) as session:
        for path in ("/", "/events", "/history"):
            async with session.get(path, headers={"Host": "evil.example.org"}) as response:
                assert response.status == 403


async def test_token_is_required_and_replaced_by_a_cookie(hub, history, tmp_path):
    (tmp_path / "token").write_text(TOKEN)
    settings = PageSettings(listen="0.0.0.0:0", token_file=tmp_path / "token")
    async with browsing(hub, history, settings) as session:
        for path in ("/", "/page.js", "/events", "/history?pack=a&span=day", "/?token=wrong", "/?token="):
            async with session.get(path) as response:
                assert response.status == 401, path
                assert "Content-Security-Policy" in response.headers
        for header in (
            {"Authorization": f"Bearer {TOKEN}0"},
            {"Authorization": TOKEN},
            {"Cookie": f"bms_page={TOKEN}"},
        ):
            async with session.get("/", headers=header) as response:
                assert response.status == 401
        async with session.get("/", headers={"Authorization": f"Bearer {TOKEN}"}) as response:
            assert response.status == 200
        async with session.get(f"/?token={TOKEN}", allow_redirects=False) as response:
            assert (response.status, response.headers["Location"]) == (303, "/")
            cookie = response.headers["Set-Cookie"]
            assert TOKEN not in cookie
            assert "HttpOnly" in cookie
            assert "SameSite=Strict" in cookie
        async with session.get("/") as response:
            assert response.status == 200


async def test_history_has_a_limited_number_of_points(tmp_path, hub):
    await record_history(tmp_path / "attic.sqlite", [snapshot_at(30.0 * s) for s in range(4000)])  # 33 h
    now_s = epoch_s(snapshot_at(30.0 * 3999).estimate.time)
    history = HistoryQuery(lambda: now_s)
    history.add("attic", tmp_path / "attic.sqlite")
    async with browsing(hub, history) as session:
        lengths = {}
        for span in ("hour", "day", "month"):
            async with session.get("/history", params={"pack": "attic", "span": span}) as response:
                assert response.status == 200
                content = await response.json()
            lengths[span] = len(content["time_s"])
            assert {len(column) for name, column in content.items() if name not in ("step_s", "events")} == {
                lengths[span]
            }
            assert content["voltage_v"][-1] == pytest.approx(snapshot_at(0.0).estimate.voltage_v)
        assert 60 <= lengths["hour"] <= 61  # minutes
        assert 288 <= lengths["day"] <= 289  # steps of 5 min
        assert 17 <= lengths["month"] <= 18  # steps of 2 h, because the history has only 33 h
        for query, status in (("pack=attic&span=x", 400), ("pack=x&span=day", 404), ("", 400)):
            async with session.get(f"/history?{query}") as response:
                assert response.status == status


async def test_a_pack_without_a_database_has_no_history(tmp_path, hub, history):
    history.add("attic", tmp_path / "attic.sqlite")
    async with browsing(hub, history) as session, session.get("/history?pack=attic&span=day") as response:
        assert response.status == 404
        assert "no history there" in await response.text()


async def test_address_in_use_is_an_error_or_retried_by_a_patient_server(hub, history, monkeypatch):
    monkeypatch.setattr(listener, "OPEN_RETRY_S", 0.05)
    opened = asyncio.Queue[str]()
    with socket.create_server(("127.0.0.1", 0)) as occupant:
        settings = PageSettings(listen=f"127.0.0.1:{occupant.getsockname()[1]}")
        with pytest.raises(UserError, match=r"page\.listen = 127\.0\.0\.1:\d+: .*in use"):
            async with PageServer(settings, hub, history, retry=False):
                pass
        server = await PageServer(settings, hub, history, on_listening=opened.put_nowait).__aenter__()
        assert opened.empty()
    async with asyncio.timeout(LONG_S):
        url = await opened.get()
    async with aiohttp.ClientSession(url) as session, session.get("/") as response:
        assert response.status == 200
    await server.__aexit__(None, None, None)


async def test_packs_that_share_an_address_share_a_page_until_the_last_one_ends():
    opened: list[str] = []
    pages, settings = Pages(opened.append), PageSettings(listen="127.0.0.1:0")
    async with PageSink(pages, settings, "attic") as attic:
        async with PageSink(pages, settings, "cellar") as cellar:
            (url,) = opened
            for sink in (attic, cellar):
                sink.publish(CELL_SNAPSHOT)
            async with aiohttp.ClientSession(url) as session, session.get("/events") as response:
                stream = stream_messages(response)
                content = await anext(stream)
                for pack in ("attic", "cellar"):
                    assert content[f"{pack}/state"] == json.loads(CELL_SNAPSHOT.estimate.model_dump_json())
                    assert content[f"{pack}/health"] == json.loads(CELL_SNAPSHOT.health.model_dump_json())
                    assert content[f"{pack}/availability"] == "online"
                await cellar.__aexit__(None, None, None)
                assert (await anext(stream))["cellar/availability"] == "offline"
                await cellar.__aenter__()
        with pytest.raises(UserError, match="must share token_file and hosts"):
            async with PageSink(pages, settings.model_copy(update={"hosts": ("x",)}), "third"):
                pass
    with pytest.raises(aiohttp.ClientConnectionError):
        async with aiohttp.ClientSession(url) as session, session.get("/"):
            pass


async def test_a_form_that_cannot_be_decoded_is_rejected(hub, history):
    async def forecast(_: bytes) -> bytes:
        return b"{}"

    async with (
        PageServer(PageSettings(listen="127.0.0.1:0"), hub, history, {"attic": forecast}, retry=False) as server,
        aiohttp.ClientSession(server.url) as session,
    ):
        headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
        async with session.post("/forecast?pack=attic", data=b'{"power_w": 5}', headers=headers) as response:
            assert (response.status, await response.text()) == (400, "the payload cannot be decoded\n")
