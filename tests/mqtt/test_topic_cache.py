"""Bounded storage of messages from any publisher."""

import json
import string

from hypothesis import given, strategies as st

from bms_estimator.mqtt.topic_cache import (
    MAX_DEVICE_BYTES,
    MAX_DEVICES,
    MAX_TOPICS,
    SILENT_S,
    DeviceMessage,
    TopicCache,
    parse_payload,
)
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from tests.sinks.snapshots import CELL_SNAPSHOT, NOW


def test_all_published_messages_are_stored_by_device_and_topic():
    cache = TopicCache("site/bms")
    messages = MessageBuilder("site/bms", "pack")
    for message in (
        *messages.birth_messages(),
        *messages.guaranteed_messages(None, CELL_SNAPSHOT),
        *messages.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)[0],
    ):
        cache.add_message(message.topic, message.payload, NOW)
    [(name, device)] = cache.devices.items()
    assert name == "pack"
    assert CELL_SNAPSHOT.estimate
    assert device.topics["state"] == CELL_SNAPSHOT.estimate.model_dump(mode="json")
    assert device.topics["availability"] == "online"
    assert {"health", "info", "parameters", "event", "sensor/availability", "schema"} <= set(device.topics)
    assert not any("homeassistant/" in topic for topic in device.topics)
    assert set(device.received_s.values()) == {NOW}


def test_invalid_json_is_returned_as_text():
    assert parse_payload(b"online") == "online"
    assert parse_payload(b'{"a": NaN}') == '{"a": NaN}'
    assert parse_payload(b'{"a": 1e999}') == '{"a": 1e999}'
    assert parse_payload(b"[" * 100_000) == "[" * 100_000
    assert parse_payload(b"\xff\x00") == "\ufffd\0"
    assert parse_payload(b'{"a": 1.5}') == {"a": 1.5}


def test_cleared_topic_is_removed_and_its_device_with_the_last_topic():
    cache = TopicCache("bms")
    cache.add_message("bms/pack/state", b"1", NOW)
    cache.add_message("bms/pack/info", b"2", NOW)
    assert cache.add_message("bms/pack/info", b"", NOW) == DeviceMessage("pack", "info", None)
    assert cache.add_message("bms/pack/info", b"", NOW) is None
    assert cache.devices["pack"].topics == {"state": 1}
    cache.add_message("bms/pack/state", b"", NOW)
    assert cache.devices == {}


def test_topics_without_a_device_are_ignored():
    cache = TopicCache("bms")
    for topic in ("bms", "bms/", "bms/pack", "bms/pack/", "bms//state", "other/pack/state", "bms/a b/state"):
        assert cache.add_message(topic, b"1", NOW) is None, topic
    for topic in ("bms/pack/request/set_soc", "bms/pack/response/state", "bms/\x1b[2J/state", f"bms/{'x' * 65}/state"):
        assert cache.add_message(topic, b"1", NOW) is None, topic
    assert cache.devices == {}


def test_devices_topics_and_bytes_are_bounded_and_stored_devices_are_updated() -> None:
    cache = TopicCache("bms")
    for number in range(2 * MAX_DEVICES):
        cache.add_message(f"bms/d{number}/state", b"1", NOW)
    assert (len(cache.devices), cache.hidden) == (MAX_DEVICES, MAX_DEVICES)
    for number in range(2 * MAX_TOPICS):
        cache.add_message(f"bms/d0/t{number}", b"1", NOW)
    assert len(cache.devices["d0"].topics) == MAX_TOPICS
    # more than a quarter of a device's capacity, because JSON adds quotes: three of them fit
    quarter = json.dumps("x" * (MAX_DEVICE_BYTES // 4)).encode()
    stored = [cache.add_message(f"bms/d1/t{number}", quarter, NOW) for number in range(10)]
    assert sum(message is not None for message in stored) == 3
    assert cache.add_message("bms/d1/state", b"2", NOW + 1.0) == DeviceMessage("d1", "state", 2)
    cache.add_message("bms/d1/t0", b"", NOW)
    assert cache.add_message("bms/d1/t9", quarter, NOW) is not None


def test_new_device_replaces_the_device_that_has_been_silent_longest() -> None:
    hidden = list[str]()  # rejected or replaced devices, in this order
    cache = TopicCache("bms", hidden.append)
    for number in range(MAX_DEVICES):
        cache.add_message(f"bms/d{number}/state", b"1", NOW + number)
    cache.add_message("bms/d0/state", b"1", NOW + MAX_DEVICES)  # d1, last received at NOW + 1 s, is now silent longest
    assert cache.add_message("bms/new/state", b"1", NOW + SILENT_S) is None
    assert hidden == ["new"]
    assert cache.add_message("bms/new/state", b"1", NOW + SILENT_S + MAX_DEVICES) == DeviceMessage("new", "state", 1)
    assert hidden == ["new", "d1"]
    assert cache.hidden == 1
    assert {"new", "d0"} <= cache.devices.keys()


def test_device_with_a_raised_alarm_is_stored_at_once_and_not_replaced() -> None:
    cache = TopicCache("bms")
    for number in range(2 * MAX_DEVICES):
        cache.add_message(f"bms/d{number}/state", b"1", NOW)
    alarm = "bms/new/alarm/over_temperature"
    assert cache.add_message(alarm, b'{"active": false}', NOW) is None
    assert cache.add_message(alarm, b'{"active": true}', NOW) is not None
    for number in range(2 * MAX_DEVICES):
        cache.add_message(f"bms/later{number}/state", b"1", NOW + 10.0 * SILENT_S)
    assert "new" in cache.devices
    cache.add_message(alarm, b'{"active": false}', NOW)
    cache.add_message("bms/last/state", b"1", NOW + 20.0 * SILENT_S)
    assert "new" not in cache.devices


def test_new_device_with_a_raised_alarm_does_not_replace_one_with_a_raised_alarm() -> None:
    cache = TopicCache("bms")
    for number in range(2 * MAX_DEVICES):
        cache.add_message(f"bms/d{number}/alarm/over_temperature", b'{"active": true}', NOW)
    assert set(cache.devices) == {f"d{number}" for number in range(MAX_DEVICES)}


@given(st.text(string.printable), st.binary(max_size=200))
def test_no_message_causes_an_exception(topic, payload):
    cache = TopicCache("bms")
    for full in (topic, f"bms/{topic}", f"bms/pack/{topic}"):
        cache.add_message(full, payload, NOW)
