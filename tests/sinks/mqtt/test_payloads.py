"""Stability of payloads, and agreement of the AsyncAPI document with the sent messages."""

import json
from typing import Any

import pytest

from bms_estimator.cli.settings.asyncapi import ARGUMENTS, document
from bms_estimator.model.payloads.health import PAYLOAD_VERSION
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.mqtt.requests import COMMANDS, READS
from bms_estimator.sinks.mqtt.topics import TOPICS
from tests.command_line import run
from tests.sinks.mqtt.payload_record import current_record, find_broken, read_record
from tests.sinks.snapshots import CELL_SNAPSHOT, CELLS_REPORT, NOW, SOC_LOW_ALARM

DOCUMENT = document("bms")
HOW_TO_UPDATE = "run `make payloads`, which rewrites tests/sinks/mqtt/payloads.json"


def test_no_field_is_removed_or_changes_its_type_without_a_new_version() -> None:
    before, after = read_record(), current_record()
    violations = find_broken(before["fields"], after["fields"])
    if after["payload_version"] == before["payload_version"]:
        assert violations == [], (
            "readers rely on these: raise PAYLOAD_VERSION in bms_estimator/model/payloads/health.py"
        )
    assert after["payload_version"] >= before["payload_version"]


def test_record_contains_all_fields() -> None:
    before, after = read_record(), current_record()
    assert after["payload_version"] == before["payload_version"], HOW_TO_UPDATE
    assert sorted(set(after["fields"]) - set(before["fields"])) == [], HOW_TO_UPDATE


def test_removed_and_changed_fields_are_detected() -> None:
    fields = current_record()["fields"]
    assert find_broken(fields, fields | {"state.new": "number"}) == []
    assert find_broken(fields, fields | {"state.voltage_v": "string"}) == ["state.voltage_v: was number, is string"]
    assert find_broken(fields, {name: kind for name, kind in fields.items() if name != "parameters.a.*.std"}) == [
        "parameters.a.*.std: was null, number, is gone"
    ]


def test_the_payload_version_is_published_in_info_and_schema() -> None:
    messages = MessageBuilder("bms", "pack")
    payloads = {
        m.topic.removeprefix("bms/pack/"): m.payload
        for m in (*messages.birth_messages(), *messages.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)[0])
    }
    assert json.loads(payloads["info"])["payload_version"] == PAYLOAD_VERSION
    assert json.loads(payloads["schema"])["payload_version"] == PAYLOAD_VERSION


def test_messages_have_qos_and_retain_of_the_topic_table() -> None:
    messages, snapshot = (
        MessageBuilder("bms", "pack"),
        CELL_SNAPSHOT._replace(alarms=(SOC_LOW_ALARM,), cells=CELLS_REPORT),
    )
    messages_by_topic = {
        m.topic.removeprefix("bms/pack/"): m
        for m in (
            *messages.guaranteed_messages(None, snapshot),
            *messages.live_messages(PublishedState(), snapshot, NOW)[0],
        )
    }
    assert messages_by_topic["alarm/soc_low"].qos == TOPICS["alarm"].qos
    assert messages_by_topic["alarm/soc_low"].retain
    for name in set(TOPICS) - {"alarm"}:
        assert (messages_by_topic[name].qos, messages_by_topic[name].retain) == (
            TOPICS[name].qos,
            TOPICS[name].retain,
        ), name
        TOPICS[name].model.model_validate_json(messages_by_topic[name].payload)


def references(node: Any) -> list[str]:
    """Return all references in a part of a JSON document."""
    if isinstance(node, dict):
        return (
            [node["$ref"]]
            if "$ref" in node
            else [reference for inner in node.values() for reference in references(inner)]
        )
    return [reference for inner in node for reference in references(inner)] if isinstance(node, list) else []


def test_references_of_the_document_resolve() -> None:
    for reference in references(DOCUMENT):
        node = DOCUMENT
        for key in reference.removeprefix("#/").split("/"):
            node = node[key]
    assert {operation["action"] for operation in DOCUMENT["operations"].values()} == {"send", "receive"}


def test_document_has_all_topics_and_fields() -> None:
    addresses = {channel["address"] for channel in DOCUMENT["channels"].values()}
    for name in ("state", "sensor/availability", "alarm/{alarm}", *(f"request/{name}" for name in COMMANDS + READS)):
        assert f"bms/{{device}}/{name}" in addresses
    schemas = DOCUMENT["components"]["schemas"]
    for topic in TOPICS.values():
        assert set(schemas[topic.model.__name__]["properties"]) == set(topic.model.model_fields)
    for channel in DOCUMENT["channels"].values():
        assert all(f"{{{parameter}}}" in channel["address"] for parameter in channel["parameters"])


def test_document_has_the_arguments_of_each_command() -> None:
    assert set(ARGUMENTS) == {*COMMANDS, *READS}
    payloads = {name: DOCUMENT["components"]["messages"][f"request_{name}"]["payload"] for name in COMMANDS + READS}
    assert payloads["set_soc"]["required"] == ["soc"]
    assert payloads["acknowledge_alarm"]["required"] == []
    assert set(payloads["current_zero"]["properties"]) == {"transaction"}


def test_command_prints_the_document(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "asyncapi", "--base-topic", "site/bms")
    assert code == 0
    assert json.loads(out) == document("site/bms")
