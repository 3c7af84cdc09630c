"""Telegraf's configuration, by Telegraf's documented rules: it makes of the payloads what the InfluxDB sink writes.

No registry here has Telegraf. The rules are those of its pages on ``mqtt_consumer``, on topic parsing and on the JSON
format: numbers become floats, nested names are joined by ``_``, null is left out, texts and truth values too unless named.
"""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from bms_estimator.model.payloads import Snapshot
from bms_estimator.sinks.exports.line_protocol import lines
from bms_estimator.sinks.mqtt.messages import MessageBuilder
from tests.sinks.snapshots import ONE, SOC_LOW

CONFIGURATION = tomllib.loads((Path(__file__).parents[2] / "deploy/telegraf/bms.conf").read_text(encoding="utf-8"))
STATE, ALARM = CONFIGURATION["inputs"]["mqtt_consumer"]
GO_RFC_3339 = "2006-01-02T15:04:05Z07:00"
"""Go takes fractions of a second where the layout has none."""
KNOWN = {
    "mqtt_consumer": "servers topics topic_tag qos persistent_session client_id topic_parsing username password "
    "name_override data_format json_time_key json_time_format json_string_fields tag_keys",
    "influxdb": "urls database namepass",
}
"""Options of the plugins and of the JSON format that its pages name."""


def made(rules: dict[str, Any], topic: str, payload: bytes) -> tuple[str, dict[str, str], dict[str, Any]]:
    """Measurement, tags and fields that Telegraf makes of a message."""
    parsing = rules["topic_parsing"][0]
    names, parts, filters = parsing["tags"].split("/"), topic.split("/"), parsing["topic"].split("/")
    assert len(names) == len(parts) == len(filters)
    assert all(rule in ("+", part) for rule, part in zip(filters, parts, strict=True))
    tags = {name: part for name, part in zip(names, parts, strict=True) if name != "_"}
    values = json.loads(payload)
    tags |= {key: values.pop(key) for key in rules.get("tag_keys", [])}
    values.pop(rules.get("json_time_key"), None)
    fields = {}
    for name, value in flattened(values):
        if isinstance(value, bool | str):
            if name in rules["json_string_fields"]:
                fields[name] = value
        elif value is not None:
            fields[name] = float(value)
    return rules["name_override"], tags, fields


def flattened(value: Any, name: str = "") -> list[tuple[str, Any]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if inner is None:
        return [(name, value)]
    return [found for key, item in inner for found in flattened(item, f"{name}_{key}".strip("_"))]


def written(line: str) -> tuple[str, dict[str, str], dict[str, Any]]:
    """The same of a line of our own; texts without spaces or commas."""
    head, fields, _ = line.split(" ")
    measurement, *tags = head.split(",")
    told = dict(field.split("=") for field in fields.split(","))
    read = {"true": True, "false": False}
    return (
        measurement,
        dict(tag.split("=") for tag in tags),
        {
            name: read[text] if text in read else text.strip('"') if text.startswith('"') else float(text)
            for name, text in told.items()
        },
    )


@pytest.fixture
def full() -> Snapshot:
    """Return a state with cells, and an alarm."""
    assert ONE.estimate
    return ONE._replace(estimate=ONE.estimate.model_copy(update={"cells_v": [3.25, None, 3.5]}), alarms=(SOC_LOW,))


def test_what_it_writes_of_a_state_and_an_alarm_is_what_our_own_sink_writes(full: Snapshot) -> None:
    state, alarm = lines(None, full)
    [sent] = [m for m in MessageBuilder("bms", "pack").must_deliver(full, full) if m.topic == "bms/pack/state"]
    assert made(STATE, sent.topic, sent.payload) == written(state)
    payload = full.alarms[0].model_dump_json().encode()
    assert made(ALARM, "bms/pack/alarm/soc_low", payload) == written(alarm)


def test_times_are_read_by_a_layout_that_takes_ours() -> None:
    assert STATE["json_time_format"] == GO_RFC_3339


def test_only_options_that_there_are_are_used() -> None:
    for plugin in (STATE, ALARM):
        assert set(plugin) <= set(KNOWN["mqtt_consumer"].split())
        assert [plugin["topics"][0]] == [parsing["topic"] for parsing in plugin["topic_parsing"]]
    [output] = CONFIGURATION["outputs"]["influxdb"]
    assert set(output) <= set(KNOWN["influxdb"].split())
