"""Recognition of publishers by their MQTT messages."""

import json
from collections.abc import Mapping

import pytest

from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.found_device import FoundDevice
from bms_estimator.setup.mqtt_recognition import PublisherRecognition

BROKER = BrokerLogin("mqtt://localhost:1883")
JK_NODE = {
    "home/jk/status": "online",
    "home/jk/sensor/jk_total_voltage/state": "52.81",
    "home/jk/sensor/jk_current/state": "-12.50",
    "home/jk/sensor/jk_temperature_sensor_1/state": "21.0",
    "home/jk/sensor/jk_cell_voltage_1/state": "3.301",
    "home/jk/sensor/jk_cell_voltage_2/state": "3.299",
}


def find(messages: Mapping[str, str]) -> list[FoundDevice]:
    recognition = PublisherRecognition()
    for topic, payload in messages.items():
        recognition.add_message(topic, payload.encode())
    return recognition.devices(BROKER)


@pytest.mark.parametrize(
    ("messages", "source", "values"),
    [
        (
            JK_NODE,
            {"kind": "mqtt", "profile": "esphome-jk", "prefix": "home/jk", "instance": "jk"},
            "52.81 V, 12.50 A, discharging",
        ),
        (
            {
                "jk-bms/sensor/jk-bms_total_voltage/state": "26.4",
                "jk-bms/sensor/jk-bms_current/state": "0",
                "jk-bms/sensor/jk-bms_temperature_sensor_1/state": "20",
            },
            {"kind": "mqtt", "profile": "esphome-jk", "prefix": "jk-bms"},
            "26.40 V, no current",
        ),
        (
            {"tele/shed/SENSOR": json.dumps({"Time": "x", "INA219": {"Voltage": 12.6, "Current": -1.5}})},
            {"kind": "mqtt", "profile": "tasmota", "prefix": "shed"},
            "12.60 V, 1.50 A, charging",
        ),
        (
            {
                "N/c0ffee/battery/512/Dc/0/Voltage": '{"value": 51.9}',
                "N/c0ffee/battery/512/Dc/0/Current": '{"value": 3.0}',
            },
            {"kind": "mqtt", "profile": "venus", "prefix": "c0ffee", "instance": "512"},
            "51.90 V, 3.00 A, charging",
        ),
        (
            {"BE/info": json.dumps({"battery_voltage": 370.1, "battery_current": -5.0, "temperature_max": 20})},
            {"kind": "mqtt", "profile": "battery-emulator"},
            "370.10 V, 5.00 A, discharging",
        ),
    ],
    ids=["jk", "jk without a group of topics", "tasmota", "venus", "battery-emulator"],
)
def test_publishers_are_recognized_by_their_topics(
    messages: Mapping[str, str], source: Mapping[str, str], values: str
) -> None:
    (device,) = find(messages)
    assert device.tables == {"source": source}
    assert device.values == values
    assert device.settings.source


def test_soc_and_capacity_of_a_bms_are_read() -> None:
    reported = {"state_of_charge": "62", "total_battery_capacity_setting": "280"}
    (device,) = find(JK_NODE | {f"home/jk/sensor/jk_{name}/state": text for name, text in reported.items()})
    assert (device.soc, device.capacity_ah) == (0.62, 280.0)


def test_cells_are_counted() -> None:
    (device,) = find(JK_NODE)
    assert device.cells == 2


def test_publishers_without_a_current_and_other_messages_are_ignored() -> None:
    assert find({"jk/sensor/jk_total_voltage/state": "26.4", "zigbee2mqtt/lamp": '{"state": "ON"}', "a/b": "1"}) == []


@pytest.mark.parametrize(
    ("live", "expected"),
    [
        ({}, 300.0),  # nothing changed
        ({"current": ["1"]}, 300.0),
        ({"current": ["1", "2", "2"]}, None),
        ({"total_voltage": ["52"], "current": ["1"], "cell_voltage_1": ["3.3"], "cell_voltage_2": ["3.3"]}, None),
    ],
)
def test_a_publisher_of_changes_is_recognized_by_its_silent_topics(
    live: Mapping[str, list[str]], expected: float | None
) -> None:
    """A publisher that also sends unchanged values needs no ``max_silent_s``, nor one of which only a temperature is silent."""
    recognition = PublisherRecognition()
    for topic, payload in JK_NODE.items():
        recognition.add_message(topic, payload.encode(), retained=True)
    for name, payloads in live.items():
        for payload in payloads:
            recognition.add_message(f"home/jk/sensor/jk_{name}/state", payload.encode())
    (device,) = recognition.devices(BROKER)
    assert device.tables["source"].get("max_silent_s") == expected


def test_two_profiles_with_equally_many_values_are_both_offered() -> None:
    found = find({"bms/sensor/bms_total_voltage/state": "26.4", "bms/sensor/bms_current/state": "1.0"})
    assert [device.name for device in found] == ["esphome-jbd:bms", "esphome-jk:bms"]
