"""Service with a BMS that publishes by MQTT: retained and invalid values, silent publishers, broker restarts."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Coroutine
from pathlib import Path
from typing import Any

import aiomqtt
from structlog.testing import capture_logs

from bms_estimator.model.cell import load_cell
from bms_estimator.process.runtime import end_tasks
from bms_estimator.service.pack_service import run_pack_service
from bms_estimator.settings.alarms import AlarmSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.captures.replay import RawCapture
from bms_estimator.sources.factory import open_source
from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S

STATE_TOPIC, HEALTH_TOPIC, AVAILABILITY_TOPIC = "bms/pack/state", "bms/pack/health", "bms/pack/sensor/availability"


def esphome_settings(broker: Broker, **source: object) -> Settings:
    """Return the settings of a pack whose JK-BMS is published by an ESPHome node, with changes of ``[source]``."""
    jk = {"kind": "mqtt", "profile": "esphome-jk", "prefix": "jk-bms", "interval_s": 0.2}
    return Settings.model_validate(
        {
            "pack": {"cell": "lfp", "capacity_ah": 100.0, "series": 16},
            "source": jk | source,
            "mqtt": {"url": broker.url},
            "publish": {"rate_hz": 10.0},
        }
    )


async def publish(broker: Broker, voltage: str, current: str) -> None:
    """Publish the four values of the node as retained messages, the default of ESPHome. Charge current is positive."""
    values = {"cell_voltage_1": "3.301", "temperature_sensor_1": "21.5", "total_voltage": voltage, "current": current}
    async with aiomqtt.Client("127.0.0.1", broker.port) as client:
        for name, value in values.items():
            await client.publish(f"jk-bms/sensor/jk-bms_{name}/state", value, qos=1, retain=True)


@contextlib.asynccontextmanager
async def publishing(broker: Broker, voltage: str, current: str) -> AsyncIterator[None]:
    """Publish the values repeatedly, also after a restart of the broker."""

    async def repeat() -> None:
        while True:
            with contextlib.suppress(aiomqtt.MqttError):
                await publish(broker, voltage, current)
            await asyncio.sleep(0.02)

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        await end_tasks(task)


@contextlib.asynccontextmanager
async def serving(pack_settings: Settings, tap: CaptureRecorder | None = None) -> AsyncIterator[None]:
    """Run a service, whose messages ``tap`` records."""
    stop = asyncio.Event()
    service = asyncio.create_task(
        run_pack_service(pack_settings, load_cell("lfp", 100.0).pack(16, 1), stop=stop, tap=tap)
    )
    try:
        yield
    finally:
        stop.set()
        await asyncio.wait_for(service, LONG_S)


async def test_only_live_and_valid_values_are_estimated_also_after_a_restart_of_the_broker(
    broker: Broker, tmp_path: Path
) -> None:
    await publish(broker, "40.00", "99.0")  # retained messages of an earlier run
    pack_settings, path = esphome_settings(broker), tmp_path / "lines.raw"
    with CaptureRecorder(path, make_header(pack_settings.sensor, pack_settings.source)) as recording:
        async with serving(pack_settings, recording):
            async with Listener(broker, "bms/#") as listener:
                await check_live_and_retained(broker, listener)
                await check_silence(listener)
                await check_invalid_payloads(broker, listener)
            broker.stop()
            broker.start()
            async with Listener(broker, "bms/#") as listener, publishing(broker, "52.00", "3.5"):
                state = await listener.wait_json(STATE_TOPIC, lambda s: s["voltage_v"] == 52.0)
                assert state["current_a"] == -3.5
                await listener.wait_json(HEALTH_TOPIC, lambda h: h["reconnects"] >= 1)
    assert min(block["voltage_v"].min() for block in RawCapture(path)) == 52.0


async def check_live_and_retained(broker: Broker, listener: Listener) -> None:
    """Check that live messages are used and retained ones are ignored."""
    await listener.wait_json(HEALTH_TOPIC, lambda h: h["line"]["retained"] == 4)
    async with publishing(broker, "53.00", "-12.5"):
        state = await listener.wait_json(STATE_TOPIC)
        assert (state["voltage_v"], state["current_a"], state["temperature_c"]) == (53.0, 12.5, 21.5)
        assert state["cell_lowest_v"] == 3.301
        await listener.wait_json(HEALTH_TOPIC, lambda h: h["sensor_online"])


async def check_silence(listener: Listener) -> None:
    """Check that the sensor goes offline after the last message."""
    online = max(
        i
        for i, (topic, payload, _) in enumerate(listener.messages)
        if (topic, payload) == (AVAILABILITY_TOPIC, b"online")
    )
    await listener.wait(AVAILABILITY_TOPIC, lambda payload: payload == b"offline", skip=online)
    health = await listener.wait_json(HEALTH_TOPIC, lambda h: not h["sensor_online"], skip=online)
    assert health["sensor_message"]


async def check_invalid_payloads(broker: Broker, listener: Listener) -> None:
    """Check that payloads without a number are counted and reported."""
    skip = len(listener.messages)
    await publish(broker, "unavailable", "nan")
    reason = f"esphome-jk jk-bms by MQTT, {broker.url}: voltage: jk-bms/sensor/jk-bms_total_voltage/state: no number: "
    health = await listener.wait_json(HEALTH_TOPIC, lambda h: (h["sensor_message"] or "").startswith(reason), skip=skip)
    assert health["line"]["missing"] >= 2
    assert not health["sensor_online"]


async def test_a_publisher_that_needs_requests_is_polled(broker: Broker) -> None:
    pack_settings = esphome_settings(broker, profile="venus", prefix="c0619ab", instance="1", ask_s=0.1)

    async def answer_requests() -> None:
        """Publish values only on request, as the device does."""
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.subscribe("R/c0619ab/#")
            async for message in client.messages:
                for name, value in (("Dc/0/Voltage", 52.5), ("Dc/0/Current", -4.0), ("Dc/0/Temperature", None)):
                    if message.topic.value.endswith(name):
                        payload = '{"value":%s}' % ("null" if value is None else value)
                        await client.publish(f"N/c0619ab/battery/1/{name}", payload)

    with capture_logs() as lines:
        await check_polling(broker, pack_settings, answer_requests())
    absences = [line["reason"] for line in lines if line["event"].startswith("a message has no value")]
    assert absences == ["temperature: N/c0619ab/battery/1/Dc/0/Temperature: no number: None"]
    assert not [line for line in lines if line["event"] == "faults on the line"]


async def check_polling(broker: Broker, pack_settings: Settings, answers: Coroutine[Any, Any, None]) -> None:
    """Check that the service polls a device, which has no temperature sensor."""
    async with Listener(broker) as listener, serving(pack_settings):
        device = asyncio.create_task(answers)
        try:
            state = await listener.wait_json(STATE_TOPIC)
            assert (state["voltage_v"], state["current_a"], state["temperature_c"]) == (52.5, 4.0, None)
            await listener.wait_json(HEALTH_TOPIC, lambda h: h["line"]["missing"] > 1)
            keepalive = await listener.wait("R/c0619ab/keepalive")
            assert keepalive == b'{"keepalive-options":["suppress-republish"]}'
        finally:
            await end_tasks(device)


async def test_the_next_broker_is_tried_and_the_unreachable_one_is_named(broker: Broker) -> None:
    unreachable = f"mqtt://127.0.0.1:{free_port()}"
    source = open_source(esphome_settings(broker, url=[unreachable, broker.url]))
    assert source
    with capture_logs() as lines:
        async with asyncio.timeout(LONG_S), source, publishing(broker, "53.00", "-12.5"):
            async for block, *_ in source:
                assert block["voltage_v"][0] == 53.0
                break
    (reason,) = (line["reason"] for line in lines if line["event"] == "no samples" and unreachable in line["reason"])
    assert reason.startswith(f"esphome-jk jk-bms by MQTT, {unreachable}: no connection to this broker: ")
    assert reason.endswith("; trying again")


async def test_a_second_publisher_raises_sensor_fault(broker: Broker) -> None:
    """The real node publishes 5 A. A second one answers each of its messages with -80 A."""
    pack_settings = esphome_settings(
        broker, profile=None, prefix=None, topic="home/pack", voltage="u", current="i", interval_s=2.0
    )
    pack_settings = pack_settings.model_copy(
        update={"alarms": AlarmSettings.model_validate({"sensor_fault": {"delay_s": 0.5}})}
    )
    attacked = asyncio.Event()

    async def run_nodes() -> None:
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            while True:
                await client.publish("home/pack", b'{"u": 53.0, "i": 5.0}')
                if attacked.is_set():
                    await client.publish("home/pack", b'{"u": 53.0, "i": -80.0}')
                await asyncio.sleep(0.05)

    async with Listener(broker, "bms/#") as listener, serving(pack_settings):
        publishers = asyncio.create_task(run_nodes())
        try:
            await listener.wait_json(STATE_TOPIC, lambda s: s["frames_received"] > 20)
            assert not json.loads(await listener.wait("bms/pack/alarm/sensor_fault"))["active"]
            attacked.set()
            alarm = await listener.wait_json("bms/pack/alarm/sensor_fault", lambda alarm: alarm["active"])
            assert alarm["text"].startswith("two publishers write the same topic (home/pack: current ")
            await listener.wait_json(HEALTH_TOPIC, lambda h: h["line"]["publisher_errors"] > 0)
        finally:
            await end_tasks(publishers)
