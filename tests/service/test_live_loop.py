"""Estimation loop with a scripted source: publications, health, requests, notices to systemd, and errors."""

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, SampleStatus
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service.alarm_monitor import AlarmMonitor
from bms_estimator.service.live_loop import LAG_INTERVAL_S, ServiceParts, run_estimation_loop
from bms_estimator.service.service_status import ServiceStatus
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.settings.pack import PackSettings, PublishSettings, Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sources.source import ReceivedSamples
from bms_estimator.telemetry.publish_window import REST_S
from tests.patience import LONG_S, until
from tests.scripted_source import Collector, ScriptedSource

CELL = load_cell("chen_mora")
SETTINGS = Settings(pack=PackSettings(initial_soc=0.5), publish=PublishSettings(rate_hz=10.0))


@dataclass
class Run:
    """Running estimation loop with its inputs and outputs."""

    source: ScriptedSource
    sink: Collector
    requests: RequestDispatcher
    task: asyncio.Task[Estimator]
    stop: asyncio.Event
    delivery: DeliveryStats

    async def ask(self, name: str, **arguments: Any) -> Any:
        """Send a request. Return the data of the response, or raise its error as a UserError."""
        response = await self.requests.handle(name, json.dumps(arguments).encode())
        assert response
        answer = json.loads(response)
        if answer["error"]:
            raise UserError(answer["error"])
        return answer["data"]

    async def end(self) -> Estimator:
        """End the source. Return the estimator once the loop has ended."""
        self.source.finish()
        return await asyncio.wait_for(self.task, LONG_S)


@asynccontextmanager
async def run_loop(
    settings: Settings = SETTINGS, cell: CellModel = CELL, clock: Clock | None = None, **parts: Any
) -> AsyncIterator[Run]:
    """Run the loop with further ``ServiceParts``, and stop it at the end."""
    source, sink, stop, delivery = ScriptedSource(), Collector(), asyncio.Event(), DeliveryStats()
    requests = RequestDispatcher(delivery, ("set_soc", "current_zero", "publish_rate"))
    task = asyncio.create_task(
        run_estimation_loop(
            settings,
            cell,
            source=source,
            sinks=[sink],
            stop=stop,
            parts=ServiceParts(ServiceStatus(delivery), requests, **parts),
            clock=clock,
        )
    )
    try:
        yield Run(source, sink, requests, task, stop, delivery)
    finally:
        stop.set()
        await asyncio.wait_for(task, LONG_S)


def estimates(sink: Collector) -> list[Estimate]:
    """Return the published estimates, in order."""
    return [s.estimate for s in sink.snapshots if s.estimate]


async def test_voltage_current_and_power_are_means_of_the_publish_window() -> None:
    async with run_loop() as run:
        run.source.give(*((0.01 * i, float(i % 2), 3.8 + 0.1 * (i % 2)) for i in range(100)))
        await run.end()
    (window,) = estimates(run.sink)
    assert window.voltage_v == pytest.approx(3.85)
    assert window.current_a == pytest.approx(0.5)
    assert window.power_w == pytest.approx(3.9 / 2)  # the mean of the products of current and voltage
    assert window.sample_rate_hz == pytest.approx(100.0)
    assert window.frames_received == 100


async def test_sinks_send_an_estimate_before_its_alarms_are_evaluated(monkeypatch) -> None:
    events, loop = list[str](), asyncio.get_running_loop()
    add, publish = AlarmMonitor.add, Collector.publish

    def logged_add(*args: Any) -> bool:
        events.append("alarms")
        return add(*args)

    def logged_publish(sink: Collector, snapshot: Snapshot) -> None:
        publish(sink, snapshot)
        if snapshot.estimate:  # as the outbox: one turn takes a message, the next one sends it
            loop.call_soon(loop.call_soon, events.append, "sent")

    monkeypatch.setattr(AlarmMonitor, "add", logged_add)
    monkeypatch.setattr(Collector, "publish", logged_publish)
    now_s = 0.0
    async with run_loop(clock=Clock(monotonic=lambda: now_s)) as run:
        for now_s in (0.2, 1.0, 1.01):
            count = events.count("alarms")
            run.source.give((now_s, 0.1, 3.8))
            await until(lambda count=count: events.count("alarms") > count)
    # the first snapshot lists alarms, and the last block is not published
    assert events[:5] == ["alarms", "sent", "sent", "alarms", "alarms"]


async def test_state_after_blocks_equals_that_after_single_steps() -> None:
    rng = np.random.default_rng(3)
    rows = [(0.01 * i, float(rng.normal(0.1, 0.05)), float(rng.normal(3.8, 0.01))) for i in range(500)]
    async with run_loop() as run:
        for i in range(0, 500, 7):
            run.source.give(*rows[i : i + 7])
        live = await run.end()
    single_steps = compiled_estimator(SETTINGS, CELL)
    SlowFit(single_steps)  # switches the history on
    for row in rows:
        single_steps.step(*row)
    assert live.record.tobytes() == single_steps.record.tobytes()


async def test_unusable_samples_are_dropped_and_counted() -> None:
    async with run_loop() as run:
        run.source.give((0.0, 0.1, 3.8))
        run.source.give(
            (0.1, np.nan, 3.8),
            (0.2, 0.1, np.inf),
            (0.3, 0.1, 0.0),  # a glitch
            (0.4, 400.0, 3.8),  # current out of range
            (0.5, 0.1, 3.8, np.nan, int(SampleStatus.VOLTAGE_SATURATED)),
            (0.6, 0.1, 3.8),
            (0.6, 0.1, 3.8),  # repeated
            (20.0, 0.1, 3.8, np.nan, int(SampleStatus.GAP)),
        )
        await run.sink.until(lambda s: s.health.samples["gaps"] == 1)
        await run.end()
    assert run.sink.snapshots[-1].health.samples == {
        "samples": 3,
        "dropped_not_finite": 2,
        "dropped_range": 2,
        "dropped_repeated": 1,
        "dropped_saturated": 1,
        "dropped_contradicted": 0,
        "time_steps_back": 0,
        "gaps": 1,
    }
    for snapshot in run.sink.snapshots:
        for payload in (*snapshot[:4], *snapshot.alarms):
            assert payload is None or "NaN" not in payload.model_dump_json()


async def test_the_sensor_is_offline_while_no_usable_samples_arrive() -> None:
    async with run_loop() as run:
        run.source.give((0.0, 0.1, 3.8))
        await run.sink.until(lambda s: s.health.sensor_online)
        silent = await run.sink.until(lambda s: s.health.samples["samples"] == 1 and not s.health.sensor_online)
        assert silent.estimate is None
        assert "no usable sample" in (silent.health.sensor_message or "")
        snapshots_before = len(run.sink.snapshots)
        run.source.give((1.0, 0.1, 380.0))
        snapshot = await run.sink.until(lambda s: "dropped" in (s.health.sensor_message or ""), skip=snapshots_before)
        assert "dropped since: 1 outside the cell's range" in (snapshot.health.sensor_message or "")
        run.source.give((2.0, 0.1, 3.8))
        await run.sink.until(lambda s: s.health.sensor_online, skip=snapshots_before)
        later = await run.sink.until(lambda s: not s.health.sensor_online, skip=len(run.sink.snapshots))
        assert "dropped" not in (later.health.sensor_message or "")


@pytest.mark.parametrize("sensor", [SensorSettings(sample_rate_hz=1), SensorSettings(protocol="text")])
async def test_a_board_slower_than_the_publish_rate_stays_online(sensor: SensorSettings) -> None:
    slow = SETTINGS.model_copy(update={"sensor": sensor})
    now_s = 0.0
    async with run_loop(slow, clock=Clock(monotonic=lambda: now_s)) as run:
        for tick in range(20):  # of 0.2 s, in which two publications are due
            if tick % 5 == 0:  # once a second
                run.source.give((now_s, 0.1, 3.8))
            now_s += 0.2
            await run.sink.until(lambda _: True, skip=len(run.sink.snapshots))
        online = [s.health.sensor_online for s in run.sink.snapshots]
        assert all(online[online.index(True) :])
        now_s += 3.0
        await run.sink.until(lambda s: not s.health.sensor_online, skip=len(online))


async def test_the_sensor_is_offline_while_all_samples_are_dropped() -> None:
    with capture_logs() as lines:
        async with run_loop() as run:
            for second in range(3):
                run.source.give(*((second + 0.01 * i, 0.1, 0.0) for i in range(100)))
                await run.sink.until(lambda s: s.health.samples["dropped_range"] == 100 * (second + 1))  # noqa: B023
            await run.end()
    (logged,) = (line["reason"] for line in lines if line["event"] == "samples are dropped")
    assert logged.startswith("the last of them 0 V, 0.1 A, where 1.5..4.5 V and up to 5 A are possible")
    health = run.sink.snapshots[-1].health
    assert not health.sensor_online
    assert "outside the cell's range" in (health.sensor_message or "")


async def test_the_drift_of_the_board_s_clock_is_published_once_it_is_measured() -> None:
    async with run_loop() as run:
        assert (await run.sink.until(lambda _: True)).health.clock_ppm is None
        run.source.clock_ppm = 3012.5
        await run.sink.until(lambda s: s.health.clock_ppm == 3012.5)


async def test_a_wrong_number_of_cells_is_logged_once() -> None:
    with capture_logs() as lines:
        async with run_loop(cell=CELL.pack(4, 1)) as run:
            for time_s in range(30):
                samples = np.array([(time_s, 1.0, 14.8, np.nan, np.nan, np.nan, 0)], dtype=SAMPLE)
                run.source.give_block(samples, np.full((1, 2), 3.7))
            await run.end()
    reasons = [line["reason"] for line in lines if line["event"] == "no estimates of single cells"]
    assert len(reasons) == 1
    assert reasons[0].startswith("2 cells are measured, but the pack has 4 in series")


async def test_the_reason_for_missing_samples_is_published() -> None:
    async with run_loop() as run:
        run.source.silence_reason = "waiting for /dev/ttyUSB0: it does not exist"
        snapshot = await run.sink.until(lambda s: s.health.sensor_message == run.source.silence_reason)
    assert snapshot.estimate is None


async def test_a_step_of_the_wall_clock_changes_only_time_stamps() -> None:
    offset = 0.0

    def wall() -> float:
        return 1_700_000_000.0 + offset

    async with run_loop(clock=Clock(wall=wall)) as run:
        run.source.give((0.0, 0.1, 3.8))
        await run.sink.until(lambda s: s.estimate is not None)
        offset = -7200.0
        snapshots_before = len(run.sink.snapshots)
        run.source.give((0.1, 0.1, 3.8))
        after = await run.sink.until(lambda s: s.estimate is not None, skip=snapshots_before)
        estimator = await run.end()
    assert after.estimate
    assert after.estimate.publish_time.startswith("2023-11-14T20:13:20")
    assert after.health.sensor_online
    assert estimator.state["time_steps_back"][0] == 0


async def test_set_soc_needs_a_sample_and_a_valid_value() -> None:
    async with run_loop() as run:
        await run.sink.until(lambda _: True)
        with pytest.raises(UserError, match="no sample"):
            await run.ask("set_soc", soc=0.8)
        run.source.give((0.0, 0.1, 3.8))
        await run.sink.until(lambda s: s.estimate is not None)
        assert (await run.ask("set_soc", soc=0.8))["before"] == pytest.approx(0.5, abs=0.02)
        for wrong in ({}, {"soc": 1.5}, {"soc": "0.5"}, {"soc": True}):
            with pytest.raises(UserError, match=r"soc = .*must be a number from 0 to 1"):
                await run.ask("set_soc", **wrong)
        estimator = await run.end()
    assert estimator.state["soc"][0] == 0.8


async def test_health_counts_dropped_messages_and_requests() -> None:
    async with run_loop() as run:
        await run.sink.until(lambda _: True)
        run.delivery.drops = 7
        run.delivery.refused_topics = ["bms/pack/request/+"]
        run.source.give((0.0, 0.1, 3.8))  # health is published again when samples arrive
        published = await run.sink.until(lambda s: s.health.sensor_online)
        assert published.health.publish_drops == 7
        assert published.health.refused_topics == ["bms/pack/request/+"]
        await run.ask("publish_rate", rate_hz=10.0)
        await run.sink.until(lambda s: s.health.requests == {"granted": 1})


@pytest.mark.parametrize("later_board", [{}, {"serial": "A1", "firmware": "1.1"}])
async def test_the_properties_of_a_silent_board_stay_published(later_board: dict[str, str]) -> None:
    async with run_loop() as run:
        run.source.board = {"serial": "A1", "firmware": "1.0"}
        run.source.give((0.0, 0.1, 3.8))
        await run.sink.until(lambda s: bool(s.info.board))
        run.source.board = {}
        snapshots_before = len(run.sink.snapshots)
        at_s = run.sink.snapshots[-1].health.uptime_s
        await run.sink.until(lambda s: s.health.uptime_s > at_s + 1.0, skip=snapshots_before)
        run.source.board = later_board
        await run.end()
    boards = [s.info.board for s in run.sink.snapshots[snapshots_before:]]
    assert {} not in boards
    assert boards[-1] == (later_board or {"serial": "A1", "firmware": "1.0"})


class ZeroRecorder:
    """Handler that counts the commands to set the board's current zero, with a clock that advances a second with each sample.

    Between sample and publication, the loop therefore publishes no snapshot without the sample.

    Attributes:
        calls: Number of commands.
        now_s: Time of the clock without samples [s].
    """

    def __init__(self) -> None:
        self.calls, self.now_s, self._counters = 0, 0.0, {"frames_received": 0}
        self.clock = Clock(monotonic=lambda: self.now_s + self._counters["frames_received"])

    async def __call__(self) -> None:
        self.calls += 1

    async def feed(self, run: Run, rows: list[tuple[float, float]]) -> None:
        """Feed one sample a second with these currents and voltages, after the first publication."""
        self._counters = run.source.counters
        while not run.sink.snapshots:
            self.now_s += 0.1
            await asyncio.sleep(0.01)
        for current_a, voltage_v in rows:
            snapshots_before = len(run.sink.snapshots)
            run.source.give((self.clock.monotonic() + 1.0, current_a, voltage_v))
            await run.sink.until(lambda s: s.estimate is not None, skip=snapshots_before)


AT_REST = [(0.03, 3.8)] * (round(REST_S) + 2)
"""Currents [A] and voltages [V] of a rest that suffices, one a second. 0.03 A may be the offset."""


async def test_current_zero_is_accepted_at_rest() -> None:
    zero = ZeroRecorder()
    async with run_loop(store_current_zero=zero, clock=zero.clock) as run:
        await zero.feed(run, AT_REST)
        assert await run.ask("current_zero") == {}
    assert zero.calls == 1


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ([], "no usable sample"),
        (AT_REST[:5], "watched for"),
        ([*AT_REST, (4.5, 3.5)], "current flows: 4.5 A"),
        ([(0.3, 3.8)] * len(AT_REST), "current flows: 0.3 A"),
        ([*AT_REST, (0.03, 3.7), (0.03, 3.7)], "the voltage moved by 0.1 V"),
    ],
)
async def test_current_zero_is_rejected_without_a_sufficient_rest(rows: list[tuple[float, float]], reason: str) -> None:
    zero = ZeroRecorder()
    async with run_loop(store_current_zero=zero, clock=zero.clock) as run:
        await zero.feed(run, rows)
        with pytest.raises(UserError, match=reason):
            await run.ask("current_zero")
    assert zero.calls == 0


async def test_current_zero_is_rejected_after_a_silence_of_the_board_that_follows_a_rest() -> None:
    zero = ZeroRecorder()
    async with run_loop(store_current_zero=zero, clock=zero.clock) as run:
        await zero.feed(run, AT_REST)
        zero.now_s += REST_S
        await run.sink.until(lambda s: not s.health.sensor_online, skip=len(run.sink.snapshots))
        await zero.feed(run, AT_REST[:2])
        with pytest.raises(UserError, match="watched for"):
            await run.ask("current_zero")
    assert zero.calls == 0


async def test_current_zero_is_rejected_by_a_source_without_it() -> None:
    async with run_loop() as run:
        await run.sink.until(lambda _: True)
        with pytest.raises(UserError, match="no zero"):
            await run.ask("current_zero")


async def test_published_parameters_have_their_source_and_a_missing_capacitance_its_reason() -> None:
    changes = {"pack": PackSettings(initial_soc=0.001), "identifier": IdentifierSettings(soc_std=0.005)}
    nearly_empty = SETTINGS.model_copy(update=changes)
    async with run_loop(nearly_empty) as run:
        run.source.give((0.0, 0.0, 2.5))
        run.source.finish()
        await run.task
        parameters = run.sink.snapshots[-1].parameters
    assert parameters.a["a16"].value == CELL.a[16]
    assert (parameters.a["a1"].source, parameters.a["a1"].std, parameters.a["a1"].valid) == ("configured", None, False)
    missing = parameters.elements["c_ts_farad"]
    assert missing.value is None
    assert "is not above delta_1" in (missing.reason or "")


async def test_systemd_is_notified_of_ready_watchdog_and_stopping(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "300000"}
        received: list[str] = []

        async def wait_for_notices(wanted: str, times: int) -> None:
            while received.count(wanted) < times:
                received.append((await asyncio.get_running_loop().sock_recv(systemd, 4096)).decode())

        async with asyncio.timeout(LONG_S):
            async with run_loop(notifier=SystemdNotifier([SETTINGS.pack.name], environment)) as run:
                await wait_for_notices("WATCHDOG=1", times=3)
                await run.end()
            await wait_for_notices("STOPPING=1", times=1)
    assert received[0].startswith("READY=1\nSTATUS=")


async def test_a_source_that_never_waits_does_not_starve_the_sinks() -> None:
    class EndlessSource(ScriptedSource):
        async def __aiter__(self) -> AsyncIterator[Any]:
            block = np.zeros(10, dtype=SAMPLE)
            block["voltage_v"] = 3.8
            while True:
                block["time_s"] = block["time_s"][-1] + 0.01 * np.arange(1, 11)
                yield ReceivedSamples(block, NO_CELLS)

    stop, sink = asyncio.Event(), Collector()
    task = asyncio.create_task(run_estimation_loop(SETTINGS, CELL, source=EndlessSource(), sinks=[sink], stop=stop))
    await sink.until(lambda _: len(estimates(sink)) >= 3)
    stop.set()
    await asyncio.wait_for(task, LONG_S)


async def test_an_exception_of_the_source_is_raised() -> None:
    class BrokenSource(ScriptedSource):
        async def __aiter__(self) -> AsyncIterator[Any]:
            raise ZeroDivisionError
            yield

    with pytest.raises(ZeroDivisionError):
        await run_estimation_loop(SETTINGS, CELL, source=BrokenSource(), sinks=[], stop=asyncio.Event())


async def test_the_lag_of_the_event_loop_is_published() -> None:
    async with run_loop() as run:
        await run.sink.until(lambda _: True)
        time.sleep(0.4)  # noqa: ASYNC251 - blocks the loop, as a slow disk or terminal would
        await run.sink.until(lambda s: s.health.loop_lag_s > 0.4 - LAG_INTERVAL_S)
        await run.end()
