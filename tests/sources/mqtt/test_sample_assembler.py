"""Samples from the MQTT messages of other projects, reasons for missing samples, and detection of a second publisher.

The payloads have the formats of the projects in ``settings/sources/mqtt_profiles.py``, with invented values.
"""

import json
import random
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bms_estimator.model.arrays import SampleStatus
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.mqtt import MqttSource
from bms_estimator.sources.mqtt.payload_value import MAX_CELL_NUMBER, InvalidValueError, read_cells, read_value
from bms_estimator.sources.mqtt.sample_assembler import SampleAssembler

Messages = list[tuple[str, str]]
"""Topics and payloads."""


def source(**settings: Any) -> MqttSource:
    """Return validated settings of an MQTT source."""
    return MqttSource.model_validate({"kind": "mqtt"} | settings)


def json_source(**settings: Any) -> MqttSource:
    """Return settings without a profile, for one JSON payload with all values."""
    return source(**{"topic": "home/pack", "voltage": "u", "current": "i"} | settings)


def feed(
    assembler: SampleAssembler, messages: Messages, at_s: float = 0.0, *, retained: bool = False
) -> list[dict[str, Any]]:
    """Feed messages that arrive together. Return the samples, including the one that is complete 0.5 s later."""
    lines = []
    for topic, payload in messages:
        assembler.add_message(topic, payload.encode(), at_s, retained=retained)
        lines.append(assembler.line(at_s))
    lines.append(assembler.line(at_s + 0.5))
    return [json.loads(line) for line in lines if line]


def esphome(node: str, voltage: str, current: str, temperature: str, cell: str, empty_slots: int = 0) -> Messages:
    """Return the messages of an ESPHome node, which publishes its 16 cells and then its other sensors.

    Args:
        node: Name of the node.
        voltage: Name of the sensor of the pack voltage.
        current: Name of the sensor of the current.
        temperature: Name of a temperature sensor.
        cell: Name of a sensor of a cell voltage, with {} for the number of the cell.
        empty_slots: Number of cell sensors without a cell, which are 0 V.
    """
    cells = [(cell.format(n), f"3.3{n:02}" if n <= 16 else "0.000") for n in range(1, 17 + empty_slots)]
    values = [
        *cells,
        (temperature, "21.5"),
        ("state_of_charge", "62"),
        (voltage, "52.98"),
        (current, "-12.34"),
        ("balancing_current", "0.000"),
    ]
    return [(f"{node}/sensor/{node}_{name}/state", value) for name, value in values]


SIXTEEN_CELLS_V = [round(3.3 + n / 1000, 3) for n in range(1, 17)]
# By project: settings of the source, messages, the sample that they give, and the sign of its current
PROJECTS: dict[str, tuple[dict[str, Any], Messages, dict[str, Any], str]] = {
    "batmon-ha": (
        {"profile": "batmon-ha", "prefix": "jk_bms"},
        [
            ("jk_bms/soc/total_voltage", "52.98"),
            ("jk_bms/soc/current", "12.34"),
            ("jk_bms/soc/balance_current", "0.0"),
            ("jk_bms/soc/soc_percent", "80.0"),
            ("jk_bms/cell_voltages/1", "3.301"),
            ("jk_bms/cell_voltages/2", "3.302"),
            ("jk_bms/cell_voltages/min", "3.301"),
            ("jk_bms/temperatures/1", "21.5"),
        ],
        {"voltage_v": 52.98, "current_a": 12.34},
        "discharge_positive",
    ),
    "esphome-jk": (
        {"profile": "esphome-jk", "prefix": "jk-bms"},
        esphome("jk-bms", "total_voltage", "current", "temperature_sensor_1", "cell_voltage_{}"),
        {
            "voltage_v": 52.98,
            "current_a": -12.34,
            "temperature_c": 21.5,
            "device_soc": 0.62,
            "cells_v": SIXTEEN_CELLS_V,
        },
        "charge_positive",
    ),
    "esphome-jbd": (
        {"profile": "esphome-jbd", "prefix": "jbd-bms-ble"},
        esphome("jbd-bms-ble", "total_voltage", "current", "temperature_1", "cell_voltage_{}"),
        {
            "voltage_v": 52.98,
            "current_a": -12.34,
            "temperature_c": 21.5,
            "device_soc": 0.62,
            "cells_v": SIXTEEN_CELLS_V,
        },
        "charge_positive",
    ),
    "esphome-daly": (
        {"profile": "esphome-daly", "prefix": "daly-bms"},
        [
            ("daly-bms/sensor/battery_voltage/state", "53.0"),
            ("daly-bms/sensor/battery_current/state", "-12.3"),
            ("daly-bms/sensor/cell_1_voltage/state", "3.301"),
        ],
        {"voltage_v": 53.0, "current_a": -12.3},
        "discharge_positive",
    ),
    "venus": (
        {"profile": "venus", "prefix": "c0619ab12345", "instance": "1"},
        [
            ("N/c0619ab12345/battery/1/Voltages/Cell1", '{"value":3.301}'),
            ("N/c0619ab12345/battery/1/Dc/0/Temperature", '{"value":21.5}'),
            ("N/c0619ab12345/battery/1/Soc", '{"value":80}'),
            ("N/c0619ab12345/battery/1/InstalledCapacity", '{"value":280}'),
            ("N/c0619ab12345/battery/1/Dc/0/Voltage", '{"value":52.98}'),
            ("N/c0619ab12345/battery/1/Dc/0/Current", '{"value":-12.34}'),
            ("N/c0619ab12345/battery/2/Dc/0/Current", '{"value":-99.0}'),
        ],
        {
            "voltage_v": 52.98,
            "current_a": -12.34,
            "temperature_c": 21.5,
            "cells_v": [3.301],
            "device_soc": 0.8,
            "device_capacity_ah": 280.0,
        },
        "charge_positive",
    ),
    "battery-emulator": (
        {"profile": "battery-emulator"},
        [
            ("BE/spec_data", '{"cell_voltages":[3.701,3.702,3.700],"cell_balancing":[false,false,true]}'),
            (
                "BE/info",
                '{"bms_status":"ACTIVE","SOC":81.5,"SOC_real":80.5,"temperature_max":21.5,"temperature_min":20.5,"battery_current":-12.3,"battery_voltage":355.2}',
            ),
        ],
        {
            "voltage_v": 355.2,
            "current_a": -12.3,
            "temperatures_c": [21.5, 20.5],
            "cells_v": [3.701, 3.702, 3.7],
            "device_soc": 0.805,
        },
        "charge_positive",
    ),
    "opendtu": (
        {"profile": "opendtu"},
        [
            ("solar/battery/BatteryTempOneCelsius", "21"),
            ("solar/battery/Cell1MilliVolt", "3301"),
            ("solar/battery/CellMinMilliVolt", "3301"),
            ("solar/battery/stateOfCharge", "62"),
            ("solar/battery/voltage", "52.98"),
            ("solar/battery/current", "-12.34"),
        ],
        {"voltage_v": 52.98, "current_a": -12.34, "temperature_c": 21.0, "device_soc": 0.62, "cells_v": [3.301]},
        "charge_positive",
    ),
    "tasmota": (
        {"profile": "tasmota", "prefix": "shunt"},
        [
            (
                "tele/shunt/SENSOR",
                '{"Time":"2026-11-11T21:57:38","INA219":{"Voltage":13.28,"Current":2.510,"Power":33.3}}',
            )
        ],
        {"voltage_v": 13.28, "current_a": 2.51},
        "discharge_positive",
    ),
    "tasmota energy": (
        {"profile": "tasmota", "prefix": "shunt", "instance": "ENERGY"},
        [("tele/shunt/SENSOR", '{"Time":"2026-11-11T21:57:38","ENERGY":{"Power":33,"Voltage":13,"Current":2.510}}')],
        {"voltage_v": 13.0, "current_a": 2.51},
        "discharge_positive",
    ),
    "zigbee2mqtt": (
        {"profile": "zigbee2mqtt", "prefix": "garage/meter"},
        [("zigbee2mqtt/garage/meter", '{"voltage":52.1,"linkquality":34,"power":167,"current":3.2,"state":"ON"}')],
        {"voltage_v": 52.1, "current_a": 3.2},
        "discharge_positive",
    ),
}


@pytest.mark.parametrize("project", PROJECTS)
def test_messages_of_a_project_are_assembled_to_one_sample(project: str) -> None:
    table, messages, sample, sign = PROJECTS[project]
    assembler = SampleAssembler(source(**table))
    assert feed(assembler, messages) == [sample]
    assert feed(assembler, messages, 10.0)[0]["current_a"] == sample["current_a"]
    assert assembler.fault is None
    assert set(assembler.counters.values()) == {0}
    assert Settings.model_validate({"source": {"kind": "mqtt"} | table}).sensor.current_sign == sign


def test_cell_voltages_published_after_the_current_belong_to_the_next_sample() -> None:
    table, messages, _, _ = PROJECTS["batmon-ha"]
    assembler = SampleAssembler(source(**table))
    feed(assembler, messages)
    assert feed(assembler, messages, 5.0)[0]["cells_v"] == [3.301, 3.302]


@pytest.mark.parametrize(
    ("settings", "payload", "sample"),
    [
        ({}, '{"u": 52.1, "i": "-3.25"}', {"voltage_v": 52.1, "current_a": -3.25}),
        (
            {"voltage": {"path": "p.0.mv", "unit": "mV"}, "current": {"path": "p.1", "unit": "mA", "scale": -1}},
            '{"p": [{"mv": 52100}, 3250]}',
            {"voltage_v": 52.1, "current_a": -3.25},
        ),
        (
            {"temperature": {"path": "t", "unit": "F"}, "current": {"path": "i", "scale": 0.1, "offset": -3000}},
            '{"u": 52.1, "i": 29967.5, "t": 70.7}',
            {"voltage_v": 52.1, "current_a": -3.25, "temperature_c": 21.5},
        ),
        (
            {"cells": {"path": "cells.C{cell}.v", "unit": "mV"}, "temperature": {"path": "t", "unit": "K"}},
            '{"u": 6.6, "i": 1, "t": 294.65, "cells": {"C01": {"v": 3301}, "C03": {"v": 3302}, "sum": 1}}',
            {"voltage_v": 6.6, "current_a": 1.0, "temperature_c": 21.5, "cells_v": [3.301, None, 3.302]},
        ),
        (
            {"cells": "c", "time": {"path": "t", "unit": "iso"}},
            '{"u": 6.6, "i": 1, "t": "2026-11-11T21:57:38Z", "c": [3.301, null, "3.302"]}',
            {"voltage_v": 6.6, "current_a": 1.0, "time_s": 1794434258.0, "cells_v": [3.301, None, 3.302]},
        ),
        (
            {"time": {"path": "t", "unit": "ms"}},
            '{"u": 6.6, "i": 1, "t": 12500}',
            {"voltage_v": 6.6, "current_a": 1.0, "time_s": 12.5},
        ),
    ],
)
def test_values_are_read_by_configured_path_unit_scale_and_time(
    settings: dict[str, Any], payload: str, sample: dict[str, Any]
) -> None:
    assert feed(SampleAssembler(json_source(**settings)), [("home/pack", payload)]) == [sample]


def test_line_of_a_pack_with_the_maximum_number_of_cells_is_decoded() -> None:
    assembler, decoder = SampleAssembler(json_source(cells="c")), TextProtocol()
    assembler.add_message(
        "home/pack",
        json.dumps({"u": 1460.1234, "i": -321.123, "c": [3.6512] * MAX_CELL_NUMBER}).encode(),
        0.0,
        retained=False,
    )
    assert decoder.feed(0.0, assembler.line(0.0)).size == 1
    assert decoder.cells.shape == (1, MAX_CELL_NUMBER)


def test_value_of_a_silent_topic_is_used_up_to_the_maximum_age() -> None:
    assembler = SampleAssembler(source(voltage={"topic": "v"}, current={"topic": "i"}, max_age_s=30.0))
    assert feed(assembler, [("v", "52")]) == []
    assert assembler.fault == "current: no message on i"
    assert feed(assembler, [("i", "1"), ("v", "51")], 1.0) == [{"voltage_v": 51.0, "current_a": 1.0}]
    assembler.add_message("i", b"2", 20.0, retained=False)
    assert assembler.line(20.4) == b""
    assert assembler.wait_s(20.4) == pytest.approx(0.1)
    assert json.loads(assembler.line(20.5)) == {"voltage_v": 51.0, "current_a": 2.0, "voltage_held": 1}
    assert assembler.wait_s(20.5) is None
    assert feed(assembler, [("i", "3")], 40.0) == []
    assert assembler.counters["stale"] == 2
    assert (
        assembler.fault
        == "voltage: no message on v for 30 s; if the publisher sends only changes, set source.max_silent_s"
    )
    assert feed(assembler, [("v", "50")], 40.4) == [{"voltage_v": 50.0, "current_a": 3.0}]
    assert assembler.fault is None


def test_a_voltage_is_used_once_and_the_samples_of_later_currents_mark_it() -> None:
    assembler, decoder = SampleAssembler(source(voltage={"topic": "v"}, current={"topic": "i"})), TextProtocol()
    messages = [(n, "i", b"1") for n in range(20)] + [(0.2, "v", b"52"), (9.9, "v", b"51"), (14.5, "v", b"50")]
    samples = []
    for time_s, topic, payload in sorted(messages):
        assembler.add_message(topic, payload, time_s, retained=False)
        for now_s in (time_s, time_s + 0.45, time_s + 0.55):
            block = decoder.feed(now_s, assembler.line(now_s))
            samples += block[["voltage_v", "status"]].tolist()
    assert [voltage_v for voltage_v, status in samples if not status & SampleStatus.VOLTAGE_HELD] == [52.0, 51.0, 50.0]
    assert len(samples) >= 20


def test_a_voltage_without_a_new_current_is_sent_at_its_own_time_and_marks_the_current() -> None:
    assembler = SampleAssembler(source(voltage={"topic": "v"}, current={"topic": "i"}, interval_s=10.0))
    assert feed(assembler, [("i", "1"), ("v", "52")]) == [{"voltage_v": 52.0, "current_a": 1.0}]
    assert feed(assembler, [("v", "51")], 5.0) == [{"voltage_v": 51.0, "current_a": 1.0, "current_held": 1}]
    assert feed(assembler, [("i", "5")], 10.0) == [{"voltage_v": 51.0, "current_a": 5.0, "voltage_held": 1}]


def test_values_once_a_minute_and_half_a_minute_apart_give_samples_without_further_settings() -> None:
    assembler = SampleAssembler(source(voltage={"topic": "v"}, current={"topic": "i"}, interval_s=60.0))
    samples = []
    for minute in range(3):
        samples += feed(assembler, [("v", "52")], 60.0 * minute) + feed(assembler, [("i", "1")], 60.0 * minute + 30.1)
    assert [("voltage_held" in sample, "current_held" in sample) for sample in samples] == [
        (True, False),
        (False, True),
    ] * 2 + [(True, False)]
    assert assembler.counters["stale"] == 1  # the first voltage, before any current


def test_the_values_of_a_publisher_that_sends_only_changes_hold_for_its_longest_silence() -> None:
    assembler = SampleAssembler(
        source(voltage={"topic": "v"}, current={"topic": "i"}, interval_s=60.0, max_silent_s=300.0)
    )
    assert feed(assembler, [("v", "52"), ("i", "1")]) == [{"voltage_v": 52.0, "current_a": 1.0}]
    now_s, repeated_s = 0.0, []
    while (wait_s := assembler.wait_s(now_s)) is not None:
        now_s += wait_s
        if line := assembler.line(now_s):
            assert json.loads(line) == {"voltage_v": 52.0, "current_a": 1.0, "voltage_held": 1}
            repeated_s.append(now_s)
    assert repeated_s == [90.0, 180.0, 270.0, 360.0]
    assert feed(assembler, [("i", "2")], 500.0) == []  # the voltage is too old


@pytest.mark.parametrize(
    ("temperature", "messages", "temperatures_c"),
    [
        pytest.param({"topic": "t/{probe}"}, [("t/2", "22"), ("t/1", "21")], [21.0, 22.0], id="topics"),
        pytest.param({"topic": "t/{probe}"}, [("t/3", "23"), ("t/1", "21")], [21.0, None, 23.0], id="missing"),
        pytest.param({"topic": "t/{probe}"}, [("t/2", "22"), ("t/2", "null"), ("t/1", "21")], [21.0, 22.0], id="null"),
        pytest.param({"topic": "t/{probe}"}, [("t/0", "1"), ("t/33", "1"), ("t/x", "1")], None, id="no probes"),
        pytest.param(
            {"topic": "t", "path": "T{probe}"}, [("t", '{"T1":21,"T2":22,"TMOS":70}')], [21.0, 22.0], id="keys"
        ),
        pytest.param(
            [{"topic": "t", "path": "0"}, {"topic": "u"}], [("u", "22"), ("t", "[21]")], [21.0, 22.0], id="list"
        ),
    ],
)
def test_all_temperature_probes_are_part_of_the_sample(
    temperature: object, messages: Messages, temperatures_c: list[float | None] | None
) -> None:
    assembler = SampleAssembler(source(voltage={"topic": "v"}, current={"topic": "i"}, temperature=temperature))
    (line,) = feed(assembler, [*messages, ("v", "52"), ("i", "1")])
    assert line.get("temperatures_c") == temperatures_c


def test_temperature_is_used_for_five_minutes() -> None:
    assembler = SampleAssembler(source(voltage={"topic": "v"}, current={"topic": "i"}, temperature={"topic": "t"}))
    voltage_and_current = [("v", "52"), ("i", "1")]
    feed(assembler, [("t", "21.5")])
    assert feed(assembler, voltage_and_current, 299.0)[0]["temperature_c"] == 21.5
    assert "temperature_c" not in feed(assembler, voltage_and_current, 301.0)[0]


@pytest.mark.parametrize("max_silent_s", [None, 600])
def test_retained_and_constant_values_count_while_a_publisher_is_online(max_silent_s: float | None) -> None:
    assembler = SampleAssembler(
        json_source(
            temperature={"topic": "home/probe"},
            soc={"topic": "home/soc"},
            availability_topic="home/status",
            max_silent_s=max_silent_s,
        )
    )
    state = [("home/pack", '{"u": 52, "i": 1}'), ("home/probe", "21"), ("home/soc", "62")]
    assert feed(assembler, state, retained=True) == []
    samples = feed(assembler, [("home/status", "online")], 1.0, retained=True)
    complete = {"voltage_v": 52.0, "current_a": 1.0, "temperature_c": 21.0, "device_soc": 0.62}
    assert samples == [complete] * bool(max_silent_s)
    (sample,) = feed(assembler, [("home/pack", '{"u": 51, "i": 2}')], 500.0)
    assert (sample["temperature_c"], sample["device_soc"]) == (21.0, 0.62)
    feed(assembler, [("home/status", "offline")], 501.0)
    (sample,) = feed(assembler, [("home/pack", '{"u": 51, "i": 2}')], 502.0)
    assert "temperature_c" not in sample


def test_the_reason_for_missing_messages_names_the_setting_of_a_publisher_of_changes() -> None:
    assembler = SampleAssembler(json_source())
    feed(assembler, [("home/pack", '{"u": 52, "i": 1}')])
    assert assembler.silence_reason == (
        "no new message on home/pack; if the publisher sends only changes, set source.max_silent_s"
    )


def test_the_reason_for_missing_messages_names_one_topic_of_each_quantity() -> None:
    assembler = SampleAssembler(source(profile="esphome-jk", prefix="jk"))
    assert assembler.fault == (
        "no message on jk/sensor/jk_total_voltage/state, jk/sensor/jk_current/state and 4 other topics"
    )


def test_retained_values_are_ignored_but_a_retained_availability_is_reported() -> None:
    assembler = SampleAssembler(json_source(availability_topic="home/status"))
    assert feed(assembler, [("home/pack", '{"u": 52, "i": 1}')], retained=True) == []
    assert assembler.counters["retained"] == 1
    assert assembler.fault == "no message on home/pack but retained messages"
    feed(assembler, [("home/status", "offline")], retained=True)
    assert assembler.fault == "the publisher reports offline on home/status"
    feed(assembler, [("home/status", '{"state":"online"}')])
    assert feed(assembler, [("home/pack", '{"u": 52, "i": 1}')], 1.0) == [{"voltage_v": 52.0, "current_a": 1.0}]
    assert assembler.fault is None


@pytest.mark.parametrize(
    ("payload", "counter", "reason"),
    [
        ('{"i": 1}', "missing", "voltage: home/pack: u: not in {'i': 1}"),
        ('{"u": "unavailable", "i": 1}', "missing", "no number: 'unavailable'"),
        ('{"u": null, "i": 1}', "missing", "no number: None"),
        ('{"u": NaN, "i": 1}', "missing", "no number: 'NaN'"),
        ('{"u": true, "i": 1}', "no_number", "no number: True"),
        ('{"u": [], "i": 1}', "no_number", "no number: []"),
        ('{"u": 1e999, "i": 1}', "no_number", "no number: inf"),
        ('{"u": 1%s, "i": 1}' % (400 * "0"), "no_number", "no number: 1000"),
        ("unavailable", "no_number", "no JSON: 'unavailable'"),
        ("", "no_number", "no JSON: ''"),
        ("3_9", "no_number", "no JSON: '3_9'"),
        ("42", "missing", "u: not in 42"),
        (5000 * "[", "no_number", "no JSON: '[[["),
    ],
)
def test_invalid_payload_is_counted_and_reported(payload: str, counter: str, reason: str) -> None:
    assembler = SampleAssembler(json_source())
    assert feed(assembler, [("home/pack", payload)]) == []
    assert assembler.counters[counter] >= 1
    assert reason in (assembler.fault or "")
    assert feed(assembler, [("home/pack", '{"u": 52, "i": 1}')], 1.0) == [{"voltage_v": 52.0, "current_a": 1.0}]
    assert reason in assembler.first_faults[counter]  # also after valid values


@given(st.binary() | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(json.dumps).map(str.encode))
def test_no_payload_raises_another_error(payload: bytes) -> None:
    settings = json_source(cells="c.{cell}", temperature={"path": "0.1"}, time={"path": "t", "unit": "iso"})
    assembler = SampleAssembler(settings)
    assembler.add_message("home/pack", payload, 0.0, retained=False)
    assembler.line(1.0)
    for name, place in settings.locations():
        for read in (read_value, read_cells):
            try:
                read(payload, place, name)
            except InvalidValueError:
                continue


@pytest.mark.parametrize(
    ("prefix", "instance", "name_prefix"),
    [("jk-bms", "", "jk-bms_"), ("jk-bms", "", ""), ("home/bms", "jk-bms", "jk-bms_")],
)
def test_esphome_node_may_have_a_prefix_of_its_own_and_sensors_without_the_name_of_the_node(
    prefix: str, instance: str, name_prefix: str
) -> None:
    assembler = SampleAssembler(source(profile="esphome-jk", prefix=prefix, instance=instance))
    values = [("total_voltage", "52.98"), ("current", "-12.34"), ("balancing_current", "1")]
    sample = feed(assembler, [(f"{prefix}/sensor/{name_prefix}{name}/state", value) for name, value in values])
    assert sample == [{"voltage_v": 52.98, "current_a": -12.34}]


def test_topics_of_several_values_are_subscribed_once() -> None:
    assert SampleAssembler(source(profile="esphome-jk", prefix="jk-bms")).topics == [
        "jk-bms/sensor/+/state",
        "jk-bms/status",
    ]
    assert SampleAssembler(json_source()).topics == ["home/pack"]


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({}, "voltage: missing; give its path, or choose a profile: batmon-ha"),
        ({"profile": "venus"}, "profile venus: prefix: missing (VRM portal ID"),
        ({"profile": "tasmota"}, "profile tasmota: prefix: missing (Topic of the device"),
        ({"voltage": "u", "current": "i"}, "voltage.topic: missing, and source.topic is not set"),
        (
            {"topic": "t", "voltage": {"path": "u", "unit": "A"}, "current": "i"},
            "voltage.unit = A: must be one of V, mV",
        ),
        ({"topic": "t", "voltage": {"path": "u", "scale": 0}, "current": "i"}, "voltage.scale = 0: must not be 0"),
        ({"topic": "t", "voltage": "u", "current": "i", "username": "me"}, "apply to the broker in source.url"),
    ],
)
def test_invalid_settings_are_rejected_with_a_reason(table: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match="mqtt") as caught:
        Settings.model_validate({"source": {"kind": "mqtt"} | table})
    assert reason in str(caught.value)


def test_settings_override_the_profile() -> None:
    merged = source(profile="battery-emulator", current={"scale": -1}, temperature="temperature_min", interval_s=2)
    assert merged.current.topics == ("{prefix}/info{instance}",)
    assert (merged.current.path, merged.current.scale) == ("battery_current", -1.0)
    assert [location.path for location in merged.temperature] == ["temperature_min"]
    assert (merged.prefix, merged.period_s) == ("BE", 2.0)  # the prefix is that of the profile


class _Publisher(NamedTuple):
    """Publisher of a constant current at regular intervals."""

    period_s: float
    first_s: float
    last_s: float
    current_a: float


def _merge_publishers(*publishers: _Publisher) -> list[tuple[float, float]]:
    """Return the times and currents of the messages of all publishers, in the order of their times."""
    messages = [
        (publisher.first_s + publisher.period_s * i, publisher.current_a)
        for publisher in publishers
        for i in range(round((publisher.last_s - publisher.first_s) / publisher.period_s))
    ]
    return sorted(messages)


def _conflict_times(messages: list[tuple[float, float]]) -> tuple[SampleAssembler, list[float]]:
    """Feed the times and currents of messages.

    Return the assembler, and the times of the messages at which two publishers were detected [s].
    """
    assembler, times_s = SampleAssembler(json_source()), list[float]()
    for at_s, current_a in messages:
        errors_before = assembler.counters["publisher_errors"]
        assembler.add_message("home/pack", json.dumps({"u": 52.0, "i": current_a}).encode(), at_s, retained=False)
        times_s += [at_s] * (assembler.counters["publisher_errors"] - errors_before)
    return assembler, times_s


@pytest.mark.parametrize("period_s", [0.2, 1.0, 2.7])
def test_second_publisher_of_a_topic_is_reported_until_it_stops(period_s: float) -> None:
    publisher = _Publisher(period_s=1.0, first_s=0.0, last_s=160.0, current_a=5.0)
    second_publisher = _Publisher(period_s, first_s=100.3, last_s=160.0, current_a=-80.0)
    assembler, times_s = _conflict_times(_merge_publishers(publisher, second_publisher))
    assert 100.3 < times_s[0] < 115.0
    assert times_s[-1] > 158.0
    assert set(assembler.conflict.removeprefix("home/pack: current ").split(" and ")) == {"5", "-80"}
    assembler, times_s = _conflict_times(_merge_publishers(publisher._replace(last_s=400.0), second_publisher))
    assert assembler.conflict == ""
    assert times_s[-1] < 160.0 + 3.0 * max(period_s, 1.0)  # within three messages


@pytest.mark.parametrize("on_s", [1, 2, 3, 10])
def test_load_that_switches_regularly_does_not_count_as_a_second_publisher(on_s: int) -> None:
    assembler, times_s = _conflict_times(
        [(float(second), 80.0 if second // on_s % 2 else -5.0) for second in range(1000)]
    )
    assert (assembler.conflict, times_s) == ("", [])


@pytest.mark.parametrize(("on_s", "off_s", "spread"), [(3, 60, 0.0), (600, 1800, 0.1), (5, 15, 0.9)])
def test_current_published_only_on_change_does_not_count_as_a_second_publisher(
    on_s: int, off_s: int, spread: float
) -> None:
    """The loads are a short pulse each minute, a refrigerator, and a load that is switched by hand.

    ``spread`` is the maximum relative deviation of a time from ``on_s`` and ``off_s``.
    """
    rng, messages, at_s = random.Random(1), list[tuple[float, float]](), 0.0
    for _ in range(200):
        for pause_s, current_a in ((off_s, 80.0), (on_s, 5.0)):
            at_s += pause_s * rng.uniform(1.0 - spread, 1.0 + spread)
            messages.append((at_s, current_a))
    assembler, times_s = _conflict_times(messages)
    assert (assembler.conflict, times_s) == ("", [])


@pytest.mark.parametrize("restarts", [False, True])
def test_publisher_of_changes_and_of_regular_messages_does_not_count_as_two(*, restarts: bool) -> None:
    """The load is on for 3 s of every 61 s. The regular interval of 10 s restarts at each change, or not."""
    messages: list[tuple[float, float]] = []
    for cycle in range(30):
        on_s = 61.0 * cycle
        messages += [(on_s, 80.0), (on_s + 3.0, 5.0)]
        if restarts:
            messages += [(on_s + 3.0 + 10.0 * i, 5.0) for i in range(1, 6)]
    if not restarts:
        messages += [(10.0 * i + 0.5, 80.0 if (10.0 * i + 0.5) % 61.0 < 3.0 else 5.0) for i in range(183)]
    assembler, times_s = _conflict_times(sorted(messages))
    assert (assembler.conflict, times_s) == ("", [])


@pytest.mark.parametrize(("is_random", "detected_s"), [(False, 160.0), (True, 115.0)])
def test_second_publisher_that_is_slower_or_random_is_detected(*, is_random: bool, detected_s: float) -> None:
    messages = _merge_publishers(_Publisher(period_s=1.0, first_s=0.0, last_s=200.0, current_a=5.0))
    rng, at_s = random.Random(1), 100.3
    while at_s < 160.0:  # times of the second publisher
        messages.append((at_s, -80.0))
        at_s += rng.expovariate(1.0) if is_random else 10.0
    _, times_s = _conflict_times(sorted(messages))
    assert 100.0 < times_s[0] < detected_s


def feed_each_second(assembler: SampleAssembler, messages: Iterable[Messages], begin_s: float = 0.0) -> list[Any]:
    """Feed messages, one list each second. Return the last sample of each second, or None."""
    seconds = [feed(assembler, each, begin_s + second) for second, each in enumerate(messages)]
    return [samples[-1] if samples else None for samples in seconds]


@pytest.mark.parametrize("absent", ["", ', "t": null, "u": null', ', "t": "unavailable", "u": NaN'])
def test_values_of_a_publisher_that_sends_a_part_of_them_in_each_message_hold(absent: str) -> None:
    """The payloads have a part of the values, and the others are absent or null."""
    assembler = SampleAssembler(json_source(temperature="t", interval_s=1.0))
    payloads = ['{"u": 52.0, "i": null}', '{"t": 21.5, "u": null}', *[f'{{"i": 1.0{absent}}}'] * 20]
    samples = feed_each_second(assembler, [[("home/pack", payload)] for payload in payloads])
    held = {"voltage_v": 52.0, "current_a": 1.0, "temperature_c": 21.5, "voltage_held": 1}
    assert samples == [None, None, *[held] * 20]
    assert assembler.line(60.0) == b""
    (after,) = feed(assembler, [("home/pack", '{"u": 52.0}'), ("home/pack", '{"i": 1.0}')], 299.0)
    assert after == {"voltage_v": 52.0, "current_a": 1.0, "temperature_c": 21.5}
    (late,) = feed(assembler, [("home/pack", '{"u": 52.0}'), ("home/pack", '{"i": 1.0}')], 302.0)
    assert "temperature_c" not in late


REGULAR_PAYLOAD: dict[str, object] = {"u": 52.0, "i": 1.0, "t": 21.5, "c": [3.3, 3.4]}


@pytest.mark.parametrize("messages", [1, 10])
@pytest.mark.parametrize(
    ("absent", "max_age_s", "held_s"),
    [({"t": None}, None, 2), ({"c": None}, None, 2), ({"t": "nan", "c": [None, None]}, None, 2), ({"t": None}, 20, 20)],
)
def test_a_value_of_each_message_is_removed_when_it_stays_null(
    absent: dict[str, object], max_age_s: float | None, held_s: int, messages: int
) -> None:
    assembler = SampleAssembler(json_source(temperature="t", cells="c", interval_s=1.0, max_age_s=max_age_s))
    regular = [[("home/pack", json.dumps(REGULAR_PAYLOAD))]] * messages
    without = [[("home/pack", json.dumps(REGULAR_PAYLOAD | absent))]] * (held_s + 10)
    whole = feed_each_second(assembler, regular)[-1]
    samples = feed_each_second(assembler, without, float(messages))
    removed = {"temperature_c"} if "t" in absent else set()
    removed |= {"cells_v"} if "c" in absent else set()
    assert samples[:held_s] == [whole] * held_s
    assert samples[held_s:] == [{name: whole[name] for name in whole if name not in removed}] * 10
    assert feed_each_second(assembler, regular, 100.0)[0] == whole


def test_a_key_that_disappears_from_the_messages_counts_as_null() -> None:
    assembler = SampleAssembler(json_source(temperature="t", interval_s=1.0))
    feed_each_second(assembler, [[("home/pack", '{"u": 52.0, "i": 1.0, "t": 21.5}')]] * 10)
    samples = feed_each_second(assembler, [[("home/pack", '{"u": 52.0, "i": 1.0}')]] * 3, 10.0)
    assert ["temperature_c" in sample for sample in samples] == [True, True, False]


def test_one_cell_voltage_that_stays_null_is_removed_from_the_sample() -> None:
    assembler = SampleAssembler(json_source(cells={"topic": "home/cell/{cell}"}, interval_s=1.0))
    pack, second = ("home/pack", '{"u": 52.0, "i": 1.0}'), ("home/cell/2", "3.4")
    feed_each_second(assembler, [[("home/cell/1", "3.3"), second, pack]] * 10)
    samples = feed_each_second(assembler, [[("home/cell/1", "unavailable"), second, pack]] * 3, 10.0)
    assert [sample["cells_v"] for sample in samples] == [[3.3, 3.4], [3.3, 3.4], [None, 3.4]]


def test_cell_slots_of_an_esphome_node_without_a_cell_are_no_cells() -> None:
    node = source(profile="esphome-jk", prefix="jk-bms")
    (sample,) = feed(
        SampleAssembler(node),
        esphome("jk-bms", "total_voltage", "current", "temperature_sensor_1", "cell_voltage_{}", empty_slots=8),
    )
    assert len(sample["cells_v"]) == 24
    (cells_v,) = CellSlots(16).select(np.array([sample["cells_v"]])).tolist()
    assert cells_v == [pytest.approx(3.3 + 0.001 * n) for n in range(1, 17)]
