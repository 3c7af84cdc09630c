"""Watchdog and status messages to systemd, and latency, idle time and waiting reads in health."""

import asyncio
import contextlib
import socket
from pathlib import Path

import pytest

from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service import publisher
from bms_estimator.service.live_loop import ServiceParts, run_estimation_loop
from bms_estimator.service.pack_service import recording_health
from bms_estimator.service.service_status import LatencyHistogram, ServiceStatus
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.serial.serial_port import SerialPort
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import SourceHealth
from tests.checkpoint.test_checkpoint import CELL, SETTINGS
from tests.patience import LONG_S
from tests.scripted_source import Collector, ScriptedSource


class Systemd:
    """Receiver of a pack's notifications to systemd.

    Attributes:
        notifier: Sender of the notifications, for the service under test.
    """

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)
        # a watchdog of 30 ms, so that tests do not wait
        self.notifier = SystemdNotifier([SETTINGS.pack.name], {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "30000"})

    async def wait_for(self, prefix: str) -> str:
        """Wait for a notification that begins with ``prefix``. Return it."""
        async with asyncio.timeout(LONG_S):
            while True:
                notification = (await asyncio.get_running_loop().sock_recv(self._socket, 4096)).decode()
                if notification.startswith(prefix):
                    return notification

    def received(self) -> list[str]:
        """Return the notifications that have arrived since the last call."""
        notifications = []
        with contextlib.suppress(BlockingIOError):
            while True:
                notifications.append(self._socket.recv(4096).decode())
        return notifications

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def systemd(tmp_path: Path):
    systemd = Systemd(tmp_path / "notify")
    yield systemd
    systemd.close()


async def test_a_hanging_source_stops_the_watchdog_notifications(systemd: Systemd) -> None:
    health = SourceHealth(task_idle_s=0.0, block_age_s=0.0, queued_reads=0)
    source, sink = ScriptedSource(), Collector()
    arguments = {"source": source, "sinks": [sink], "stop": asyncio.Event()}
    parts = ServiceParts(ServiceStatus(source_health=lambda: health), notifier=systemd.notifier)
    task = asyncio.create_task(run_estimation_loop(SETTINGS, CELL, **arguments, parts=parts))
    await systemd.wait_for("WATCHDOG=1")  # no sample arrives, but the source still tries
    health = health._replace(task_idle_s=publisher.SOURCE_HUNG_S + 1.0)
    for _ in range(3):
        await sink.until(lambda _: True, skip=len(sink.snapshots))
    systemd.received()  # removes notifications from before
    for _ in range(3):
        await sink.until(lambda _: True, skip=len(sink.snapshots))
    assert "WATCHDOG=1" not in systemd.received()
    source.give((0.0, 0.1, 3.8))  # while samples arrive, the state of the task does not matter
    await systemd.wait_for("WATCHDOG=1")
    source.finish()
    await asyncio.wait_for(task, LONG_S)


async def test_the_idle_time_of_a_source_s_task_grows_while_it_hangs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    now_s, opened = 0.0, asyncio.Event()

    async def hang(_: SerialPort) -> str:
        opened.set()
        await asyncio.Event().wait()
        raise AssertionError

    sensor = SensorSettings(port=str(tmp_path / "none"))
    async with SerialSource(sensor, monotonic=lambda: now_s, first_retry_s=0.001) as board:
        for _ in range(3):
            now_s += 10.0
            async with asyncio.timeout(LONG_S):
                # the next attempt to open the missing port ends the idle time
                while board.health().task_idle_s > 0.0:  # noqa: ASYNC110 - the idle time has no event
                    await asyncio.sleep(0.001)
    monkeypatch.setattr(SerialPort, "open", hang)
    async with SerialSource(sensor, monotonic=lambda: now_s) as board:
        await asyncio.wait_for(opened.wait(), LONG_S)
        now_s += 100.0
        assert board.health().task_idle_s == 100.0


async def test_systemctl_status_shows_the_soc_or_the_reason_for_missing_samples(systemd: Systemd) -> None:
    source, sink = ScriptedSource(), Collector()
    arguments = {"source": source, "sinks": [sink], "stop": asyncio.Event()}
    task = asyncio.create_task(
        run_estimation_loop(SETTINGS, CELL, **arguments, parts=ServiceParts(notifier=systemd.notifier))
    )
    assert await systemd.wait_for("READY=1") == "READY=1\nSTATUS=estimating pack"
    source.silence_reason = "waiting for /dev/none: it does not exist"
    await systemd.wait_for("STATUS=estimating pack: no samples: ")
    source.give((0.0, 0.1, 3.8))
    assert (await systemd.wait_for("STATUS=estimating pack: SOC 0.")).startswith("STATUS=estimating pack: SOC 0.5")
    source.finish()
    await asyncio.wait_for(task, LONG_S)


async def test_health_contains_the_latency_of_samples_and_the_number_of_waiting_reads() -> None:
    source, sink = ScriptedSource(), Collector()
    health = SourceHealth(task_idle_s=0.0, block_age_s=0.3, queued_reads=7)
    arguments = {"source": source, "sinks": [sink], "stop": asyncio.Event()}
    live = run_estimation_loop(
        SETTINGS, CELL, **arguments, parts=ServiceParts(ServiceStatus(source_health=lambda: health))
    )
    task = asyncio.create_task(live)
    first = await sink.until(lambda _: True)
    assert first.health.loop.latency_p50_s is None
    assert first.health.loop.reads_waiting == 7
    assert first.health.recording is None
    source.give((0.0, 0.1, 3.8))
    source.finish()
    await asyncio.wait_for(task, LONG_S)
    loop_health = {s.health.loop.latency_max_s: s.health.loop for s in sink.snapshots}[0.3]
    assert (loop_health.latency_p50_s, loop_health.latency_p99_s) == (0.3, 0.3)


def test_latency_percentiles_are_at_most_a_fifth_too_high() -> None:
    latency = LatencyHistogram()
    assert latency.pop_summary() is None
    for latency_s in [0.002] * 97 + [0.05, 0.05, 0.7]:
        latency.add(latency_s)
    p50_s, p99_s, max_s = latency.pop_summary() or (0.0, 0.0, 0.0)
    assert 0.002 <= p50_s < 0.0024
    assert 0.05 <= p99_s < 0.06
    assert max_s == 0.7
    for latency_s in (-1.0, 0.0, 1e6):  # beyond the range of the percentiles
        latency.add(latency_s)
    assert latency.pop_summary() == pytest.approx((1e-5, 284.0, 1e6), rel=0.5)


def test_health_contains_the_state_of_a_recording(tmp_path: Path) -> None:
    assert recording_health(None) is None
    with CaptureRecorder(tmp_path / "raw", make_header(SensorSettings())) as recording:
        recording.write(0.0, b"12345")
        during = recording_health(recording)
        assert during
        assert (during.on, during.bytes, during.missed_reads) == (True, 5, 0)
    after = recording_health(recording)
    assert after
    assert not after.on
