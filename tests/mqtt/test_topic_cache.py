"""Bounded storage of messages from any publisher."""

import json
import string

from hypothesis import given
from hypothesis import strategies as st

from bms_estimator.mqtt.topic_cache import (
    MAX_DEVICE_BYTES,
    MAX_DEVICES,
    MAX_TOPICS,
    SILENT_S,
    DeviceMessage,
    TopicCache,
    parsed,
)
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from tests.sinks.snapshots import NOW, ONE


def test_all_that_a_pack_publishes_is_kept_by_device_and_topic():
    published = TopicCache("site/bms")
    messages = MessageBuilder("site/bms", "pack")
    for message in (
        *messages.birth_messages(),
        *messages.must_deliver(None, ONE),
        *messages.live_messages(PublishedState(), ONE, NOW)[0],
    ):
        published.take(message.topic, message.payload, NOW)
    [(name, device)] = published.devices.items()
    assert name == "pack"
    assert ONE.estimate
    assert device.topics["state"] == ONE.estimate.model_dump(mode="json")
    assert device.topics["availability"] == "online"
    assert {"health", "info", "parameters", "event", "sensor/availability", "schema"} <= set(device.topics)
    assert not any("homeassistant/" in topic for topic in device.topics)
    assert set(device.heard_s.values()) == {NOW}


def test_what_is_no_json_is_text_and_no_number_is_infinite():
    assert parsed(b"online") == "online"
    assert parsed(b'{"a": NaN}') == '{"a": NaN}'
    assert parsed(b'{"a": 1e999}') == '{"a": 1e999}'
    assert parsed(b"[" * 100_000) == "[" * 100_000
    assert parsed(b"\xff\x00") == "\ufffd\0"
    assert parsed(b'{"a": 1.5}') == {"a": 1.5}


def test_a_topic_that_is_emptied_is_gone_and_with_its_last_the_device():
    published = TopicCache("bms")
    published.take("bms/pack/state", b"1", NOW)
    published.take("bms/pack/info", b"2", NOW)
    assert published.take("bms/pack/info", b"", NOW) == DeviceMessage("pack", "info", None)
    assert published.take("bms/pack/info", b"", NOW) is None
    assert published.devices["pack"].topics == {"state": 1}
    published.take("bms/pack/state", b"", NOW)
    assert published.devices == {}


def test_what_is_of_no_device_is_not_looked_at():
    published = TopicCache("bms")
    for topic in ("bms", "bms/", "bms/pack", "bms/pack/", "bms//state", "other/pack/state", "bms/a b/state"):
        assert published.take(topic, b"1", NOW) is None, topic
    for topic in ("bms/pack/request/set_soc", "bms/pack/response/state", "bms/\x1b[2J/state", f"bms/{'x' * 65}/state"):
        assert published.take(topic, b"1", NOW) is None, topic
    assert published.devices == {}


def test_devices_topics_and_bytes_are_bounded_and_known_devices_are_updated() -> None:
    published = TopicCache("bms")
    for number in range(2 * MAX_DEVICES):
        published.take(f"bms/d{number}/state", b"1", NOW)
    assert (len(published.devices), published.hidden) == (MAX_DEVICES, MAX_DEVICES)
    for number in range(2 * MAX_TOPICS):
        published.take(f"bms/d0/t{number}", b"1", NOW)
    assert len(published.devices["d0"].topics) == MAX_TOPICS
    quarter = json.dumps("x" * (MAX_DEVICE_BYTES // 4)).encode()
    taken = [published.take(f"bms/d1/t{number}", quarter, NOW) for number in range(10)]
    assert sum(heard is not None for heard in taken) == 3
    assert published.take("bms/d1/state", b"2", NOW + 1.0) == DeviceMessage("d1", "state", 2)
    published.take("bms/d1/t0", b"", NOW)
    assert published.take("bms/d1/t9", quarter, NOW) is not None


def test_a_new_device_replaces_the_one_that_has_been_silent_longest() -> None:
    left_out = list[str]()
    published = TopicCache("bms", left_out.append)
    for number in range(MAX_DEVICES):
        published.take(f"bms/d{number}/state", b"1", NOW + number)
    published.take("bms/d0/state", b"1", NOW + MAX_DEVICES)
    assert published.take("bms/new/state", b"1", NOW + SILENT_S) is None
    assert left_out == ["new"]
    assert published.take("bms/new/state", b"1", NOW + SILENT_S + MAX_DEVICES) == DeviceMessage("new", "state", 1)
    assert left_out == ["new", "d1"]
    assert published.hidden == 1
    assert {"new", "d0"} <= published.devices.keys()


def test_a_raised_alarm_finds_room_at_once_and_its_device_is_kept() -> None:
    published = TopicCache("bms")
    for number in range(2 * MAX_DEVICES):
        published.take(f"bms/d{number}/state", b"1", NOW)
    alarm = "bms/new/alarm/over_temperature"
    assert published.take(alarm, b'{"active": false}', NOW) is None
    assert published.take(alarm, b'{"active": true}', NOW) is not None
    for number in range(2 * MAX_DEVICES):
        published.take(f"bms/later{number}/state", b"1", NOW + 10.0 * SILENT_S)
    assert "new" in published.devices
    published.take(alarm, b'{"active": false}', NOW)
    published.take("bms/last/state", b"1", NOW + 20.0 * SILENT_S)
    assert "new" not in published.devices


def test_raised_alarms_of_new_devices_do_not_replace_a_device_with_a_raised_alarm() -> None:
    published = TopicCache("bms")
    for number in range(2 * MAX_DEVICES):
        published.take(f"bms/d{number}/alarm/over_temperature", b'{"active": true}', NOW)
    assert set(published.devices) == {f"d{number}" for number in range(MAX_DEVICES)}


@given(st.text(string.printable), st.binary(max_size=200))
def test_nothing_that_comes_raises(topic, payload):
    published = TopicCache("bms")
    for full in (topic, f"bms/{topic}", f"bms/pack/{topic}"):
        published.take(full, payload, NOW)
