"""InfluxDB sink with a real server, during outages, and with rejections."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import structlog

from bms_estimator.model.errors import TemporaryError
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.settings.connections import InfluxSettings
from bms_estimator.sinks.exports.influx import BATCH_LINES, MAX_WAITING, InfluxSink, lines
from tests.influxdb import InfluxDB
from tests.patience import until
from tests.sinks.snapshots import CELL_SNAPSHOT, SNAPSHOT_WITHOUT_SAMPLES, SOC_LOW_ALARM

ALARM_TO_ESCAPE = SOC_LOW_ALARM.model_copy(update={"text": 'charge "it" soon, \\now\nor never'})
"""Alarm whose text has characters that the line protocol escapes or cannot carry."""


def snapshot_at(second: int, **changes: Any) -> Snapshot:
    """Return a snapshot with changed values of its estimate, ``second`` seconds after 12:00:00.250."""
    assert CELL_SNAPSHOT.estimate
    time = f"2024-05-01T12:{second // 60:02}:{second % 60:02}.250Z"
    return CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update={"time": time} | changes))


@pytest.fixture(scope="module")
def influxdb(tmp_path_factory: pytest.TempPathFactory) -> Iterator[InfluxDB]:
    with InfluxDB(tmp_path_factory.mktemp("influxdb")) as server:
        yield server


def sink(url: str, **options: Any) -> InfluxSink:
    """Return a sink that writes ten times a second, unless ``options`` change its settings."""
    settings_values = {"url": url, "database": "bms", "every_s": 0.1} | options
    return InfluxSink(InfluxSettings(**settings_values), first_delay_s=0.1)


async def test_written_lines_can_be_queried(influxdb: InfluxDB) -> None:
    async with sink(influxdb.url) as influx:
        state = snapshot_at(0, voltage_v=51.25, cells_v=[3.25, None, 3.5])
        influx.publish(state._replace(alarms=(ALARM_TO_ESCAPE,)))
        await until(lambda: not influx.waiting)
        [row] = await asyncio.to_thread(influxdb.ask, "SELECT * FROM bms_state")
        assert row["device"] == "pack"
        # the server returns its times in milliseconds
        assert row["time"] == 1000 * datetime.fromisoformat("2024-05-01T12:00:00.250Z").timestamp()
        assert (row["voltage_v"], row["lock"], row["crc_errors"]) == (51.25, state.estimate.lock, 3.0)
        assert (row["cells_v_0"], row["cells_v_2"]) == (3.25, 3.5)
        assert "cells_v_1" not in row
        assert "temperature_c" not in row
        [alarm] = await asyncio.to_thread(influxdb.ask, "SELECT * FROM bms_alarm")
        assert (alarm["name"], alarm["severity"], alarm["active"], alarm["limit"]) == ("soc_low", "warning", True, 10.0)
        assert alarm["text"] == 'charge "it" soon, \\now or never'


async def test_lines_of_an_outage_are_written_afterwards(influxdb: InfluxDB) -> None:
    async with sink(influxdb.url) as influx:
        await asyncio.to_thread(influxdb.stop)
        with structlog.testing.capture_logs() as logs:
            for second in range(100, 110):
                influx.publish(snapshot_at(second))
            await until(lambda: logs)
            await asyncio.to_thread(influxdb.start)
            await until(lambda: not influx.waiting)
        events = [entry["event"] for entry in logs]
        assert events[0] == "lines are not written to influxdb"
        assert events.count("lines are written to influxdb again") == 1
        rows = await asyncio.to_thread(influxdb.ask, "SELECT * FROM bms_state WHERE time >= '2024-05-01T12:01:40Z'")
        assert len(rows) == 10
    assert influx.dropped == 0


async def test_queued_lines_are_written_at_shutdown(influxdb: InfluxDB) -> None:
    async with sink(influxdb.url, every_s=3600.0) as influx:
        influx.publish(snapshot_at(600, frames_received=777))
    assert influx.waiting == 0
    assert await asyncio.to_thread(influxdb.ask, "SELECT * FROM bms_state WHERE frames_received = 777")


class ConfiguredHandler(BaseHTTPRequestHandler):
    """HTTP handler that stores the requests, and gives the responses of a list in turn and the last of them forever."""

    def do_POST(self) -> None:
        server: Any = self.server
        server.requests.append((self.path, dict(self.headers), self.rfile.read(int(self.headers["Content-Length"]))))
        status, text = server.responses[0] if len(server.responses) == 1 else server.responses.pop(0)
        self.send_response(status)
        self.send_header("Location", "/elsewhere")
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Any]:
    """Start an HTTP server. Its list ``responses`` has pairs of status and text, and is changed by the tests."""
    with ThreadingHTTPServer(("127.0.0.1", 0), ConfiguredHandler) as server:
        configured: Any = server
        configured.requests, configured.responses = [], [(204, b"")]
        configured.url = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield configured
        server.shutdown()
        thread.join()


async def test_influxdb_2_request_has_bucket_and_token(server: Any, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("secret\n")
    settings = InfluxSettings(url=server.url + "/in/", bucket="b c", org="home", token_file=token, every_s=0.1)
    async with InfluxSink(settings) as influx:
        influx.publish(snapshot_at(0))
        await until(lambda: server.requests)
    path, headers, body = server.requests[0]
    assert path == "/in/api/v2/write?bucket=b+c&org=home&precision=ms"
    assert headers["Authorization"] == "Token secret"
    assert body.decode() == "\n".join(lines(None, snapshot_at(0)))


async def test_lines_rejected_by_status_400_are_dropped_and_by_302_or_503_retried(server: Any) -> None:
    server.responses = [(302, b""), (503, b"busy"), (400, b"bad \x1b line"), (204, b"")]
    async with sink(server.url) as influx:
        with structlog.testing.capture_logs() as logs:
            influx.publish(snapshot_at(0))
            await until(lambda: influx.dropped)
            influx.publish(snapshot_at(1))
            await until(lambda: not influx.waiting)
    bodies = [body for _, _, body in server.requests]
    assert bodies[0] == bodies[1] == bodies[2] != bodies[3]
    assert influx.dropped == 1
    reasons = [entry["reason"] for entry in logs if "reason" in entry]
    assert [reason[:3] for reason in reasons] == ["302", "503", "400"]
    assert all(reason.isprintable() for reason in reasons)


async def test_queue_is_bounded_and_sent_in_batches(server: Any) -> None:
    server.responses = [(503, b"")]
    async with sink(server.url) as influx:
        influx.publish(snapshot_at(0))
        await until(lambda: server.requests)
        for second in range(1, MAX_WAITING + 2 * BATCH_LINES):
            influx.publish(snapshot_at(second % 3600))
        assert influx.waiting <= MAX_WAITING + BATCH_LINES
        assert influx.dropped >= BATCH_LINES - 1
        server.responses = [(204, b"")]
        await until(lambda: not influx.waiting)
    assert max(body.count(b"\n") + 1 for _, _, body in server.requests) <= BATCH_LINES


async def test_server_without_response_does_not_block_shutdown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "bms_estimator.sinks.exports.influx.SHUTDOWN_TIMEOUT_S", 0.2
    )  # the last lines cannot be written
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the kernel accepts connections, but no program responds
        async with sink(f"http://127.0.0.1:{silent.getsockname()[1]}") as influx:
            for second in range(20):
                influx.publish(snapshot_at(second))
        assert influx.waiting == 20


async def test_truncated_response_is_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "bms_estimator.sinks.exports.influx.SHUTDOWN_TIMEOUT_S", 0.2
    )  # the last lines cannot be written
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def send_truncated_response() -> None:
            """Announce chunks, and end within the length of the first."""
            connection, _ = listening.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 503 Busy\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n")
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(65_536):
                    pass

        with structlog.testing.capture_logs() as logs:
            async with sink(f"http://127.0.0.1:{listening.getsockname()[1]}") as influx:
                response_sent = asyncio.create_task(asyncio.to_thread(send_truncated_response))
                influx.publish(snapshot_at(0))
                await response_sent
                await until(lambda: logs)
                influx.publish(snapshot_at(1))
        assert logs[0]["reason"].startswith("503 Busy")
        assert influx.waiting == 2


async def test_invalid_host_name_is_reported() -> None:
    with structlog.testing.capture_logs() as logs:
        async with sink("http://influx..local:8086") as influx:
            influx.publish(snapshot_at(0))
            await until(lambda: logs)
            influx.publish(snapshot_at(1))
    assert "label empty or too long" in logs[0]["reason"]


@pytest.mark.parametrize(
    ("settings_values", "message"),
    [
        ({"bucket": "b", "username": "me"}, "of no use with bucket"),
        ({"org": "o"}, "of no use without bucket"),
        ({"url": "http://me:secret@house"}, "url"),
        ({"url": "udp://house"}, "url"),
    ],
)
def test_invalid_settings_are_rejected(settings_values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        InfluxSettings(**({"database": "bms"} | settings_values))


def test_unusable_file_raises_an_error_at_start(tmp_path: Path) -> None:
    with pytest.raises(TemporaryError, match=r"influx\.token_file = .*none: cannot be read: No such file"):
        InfluxSink(InfluxSettings(bucket="b", token_file=tmp_path / "none"))
    (tmp_path / "token").write_text("t\N{EURO SIGN}ken", encoding="utf-8")
    with pytest.raises(TemporaryError, match=r"influx\.token_file = .*token: must be ASCII"):
        InfluxSink(InfluxSettings(bucket="b", token_file=tmp_path / "token"))
    (tmp_path / "ca").write_text("nonsense")
    with pytest.raises(TemporaryError, match=r"influx\.ca_file = .*: no certificates"):
        InfluxSink(InfluxSettings(url="https://house", bucket="b", ca_file=tmp_path / "ca"))


def test_snapshot_without_changes_has_no_lines() -> None:
    assert lines(None, SNAPSHOT_WITHOUT_SAMPLES) == []
    raised = SNAPSHOT_WITHOUT_SAMPLES._replace(alarms=(ALARM_TO_ESCAPE,))
    [line] = lines(SNAPSHOT_WITHOUT_SAMPLES, raised)
    assert line.startswith(
        "bms_alarm,device=pack,name=soc_low,severity=warning active=true,watched=true,value=9.5,limit=10.0,text="
    )
    assert lines(raised, raised) == []
