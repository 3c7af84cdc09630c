"""Simulated ESPHome node of a JK-BMS, read by the MQTT source with the profile esphome-jk."""

import asyncio

import pytest

from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.esphome_node import SimulatedNode
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.factory import open_source
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S


async def test_the_mqtt_source_receives_current_with_its_sign_voltage_temperature_and_cells_of_the_node(
    broker: Broker,
) -> None:
    settings = Settings.model_validate(
        {"source": {"kind": "mqtt", "url": broker.url, "profile": "esphome-jk", "prefix": "bms7"}}
    )
    source = open_source(settings)
    assert source

    def pack(time_s: float) -> Reading:
        return Reading(current_a=12.5 if time_s > 0 else 0.0, voltage_v=53.0, temperature_c=21.5)

    node = SimulatedNode(pack, cells=16, mqtt=MqttSettings(url=broker.url), prefix="bms7", speed=20.0)
    async with asyncio.timeout(LONG_S), Listener(broker, "bms7/status") as listener, source:
        node_task = asyncio.create_task(node.run(1e9))  # longer than the test
        received_samples = 0
        async for block, cells_v, *_ in source:
            assert (block["voltage_v"] == 53.0).all()
            assert (block["current_a"] == 12.5).all()
            assert cells_v.shape == (block.size, 16)
            assert cells_v.mean() == pytest.approx(53.0 / 16, abs=1e-3)
            received_samples += block.size
            if received_samples >= 3:
                break
        assert block["temperature_c"][-1] == 21.5
        node_task.cancel()  # as Ctrl-C does; then the broker publishes the will
        await asyncio.gather(node_task, return_exceptions=True)
        await listener.wait("bms7/status", lambda payload: payload == b"offline")


async def test_node_stops_after_its_duration_and_publishes_offline(broker: Broker) -> None:
    pack = Reading(current_a=1.0, voltage_v=3.3, temperature_c=21.5)
    node = SimulatedNode(lambda _: pack, cells=1, mqtt=MqttSettings(url=broker.url), speed=1000.0)
    async with asyncio.timeout(LONG_S), Listener(broker, "jk-bms/#") as listener:
        await node.run(10.0)
        await listener.wait("jk-bms/status", lambda payload: payload == b"offline")
    assert node.samples == 5  # one each 2 s
    assert listener.all("jk-bms/sensor/jk-bms_current/state") == 5 * [
        b"-1.00"
    ]  # a JK-BMS reports a discharge as negative
