"""Telegraf's configuration yields, by Telegraf's documented rules, the metrics that the InfluxDB sink writes.

Telegraf itself is not run. The rules are those of its documentation of ``mqtt_consumer``, topic parsing and the JSON format:
numbers become floats, nested names are joined by ``_``, and null is omitted. Texts and booleans are omitted, too, unless
``json_string_fields`` names them.
"""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.sinks.exports.influx import lines
from bms_estimator.sinks.mqtt.messages import MessageBuilder
from tests.sinks.snapshots import CELL_SNAPSHOT, SOC_LOW_ALARM

CONFIGURATION = tomllib.loads((Path(__file__).parents[2] / "deploy/telegraf/bms.conf").read_text(encoding="utf-8"))
STATE_INPUT, ALARM_INPUT = CONFIGURATION["inputs"]["mqtt_consumer"]
GO_RFC_3339 = "2006-01-02T15:04:05Z07:00"
"""Time layout of Go. Go also parses fractions of a second that the layout does not contain."""
KNOWN_OPTIONS = {
    "mqtt_consumer": "servers topics topic_tag qos persistent_session client_id topic_parsing username password "
    "name_override data_format json_time_key json_time_format json_string_fields tag_keys",
    "influxdb": "urls database namepass",
}
"""Options of the plugins and of the JSON format in Telegraf's documentation."""


def telegraf_metric(plugin: dict[str, Any], topic: str, payload: bytes) -> tuple[str, dict[str, str], dict[str, Any]]:
    """Return measurement, tags and fields that Telegraf's input ``plugin`` derives from a message."""
    parsing = plugin["topic_parsing"][0]
    names, parts, filters = parsing["tags"].split("/"), topic.split("/"), parsing["topic"].split("/")
    assert len(names) == len(parts) == len(filters)
    assert all(level in ("+", part) for level, part in zip(filters, parts, strict=True))
    tags = {name: part for name, part in zip(names, parts, strict=True) if name != "_"}
    values = json.loads(payload)
    tags |= {key: values.pop(key) for key in plugin.get("tag_keys", [])}
    values.pop(plugin.get("json_time_key"), None)
    fields = {}
    for name, value in flatten(values):
        if isinstance(value, bool | str):
            if name in plugin["json_string_fields"]:
                fields[name] = value
        elif value is not None:
            fields[name] = float(value)
    return plugin["name_override"], tags, fields


def flatten(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Return the scalars inside a JSON value, with their joined names."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if inner is None:
        return [(name, value)]
    return [pair for key, item in inner for pair in flatten(item, f"{name}_{key}".strip("_"))]


def sink_metric(line: str) -> tuple[str, dict[str, str], dict[str, Any]]:
    """Return measurement, tags and fields of a line of the InfluxDB sink. Its texts must not have spaces or commas."""
    head, fields, _ = line.split(" ")
    measurement, *tags = head.split(",")
    texts_by_field = dict(field.split("=") for field in fields.split(","))
    booleans = {"true": True, "false": False}
    return (
        measurement,
        dict(tag.split("=") for tag in tags),
        {
            name: booleans[text] if text in booleans else text.strip('"') if text.startswith('"') else float(text)
            for name, text in texts_by_field.items()
        },
    )


@pytest.fixture
def snapshot() -> Snapshot:
    """Return a snapshot with cell voltages and an alarm."""
    assert CELL_SNAPSHOT.estimate
    return CELL_SNAPSHOT._replace(
        estimate=CELL_SNAPSHOT.estimate.model_copy(update={"cells_v": [3.25, None, 3.5]}), alarms=(SOC_LOW_ALARM,)
    )


def test_metrics_of_a_state_and_an_alarm_equal_those_of_the_influxdb_sink(snapshot: Snapshot) -> None:
    state, alarm = lines(None, snapshot)
    # the two snapshots are equal, so that there are no event messages
    [state_message] = [
        m for m in MessageBuilder("bms", "pack").guaranteed_messages(snapshot, snapshot) if m.topic == "bms/pack/state"
    ]
    assert telegraf_metric(STATE_INPUT, state_message.topic, state_message.payload) == sink_metric(state)
    payload = snapshot.alarms[0].model_dump_json().encode()
    assert telegraf_metric(ALARM_INPUT, "bms/pack/alarm/soc_low", payload) == sink_metric(alarm)


def test_time_layout_is_rfc_3339() -> None:
    assert STATE_INPUT["json_time_format"] == GO_RFC_3339


def test_topics_are_parsed_by_their_own_pattern() -> None:
    assert all(
        plugin["topics"] == [parsing["topic"] for parsing in plugin["topic_parsing"]]
        for plugin in (STATE_INPUT, ALARM_INPUT)
    )


def test_only_documented_options_are_used() -> None:
    for plugin in (STATE_INPUT, ALARM_INPUT):
        assert set(plugin) <= set(KNOWN_OPTIONS["mqtt_consumer"].split())
    [output] = CONFIGURATION["outputs"]["influxdb"]
    assert set(output) <= set(KNOWN_OPTIONS["influxdb"].split())
