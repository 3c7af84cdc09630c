"""Messages for a broker, without a broker."""

import json
import re
from pathlib import Path

import pytest

from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.mqtt.connection import Message
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.mqtt.topics import schema
from tests.sinks.snapshots import CELL_SNAPSHOT, NOW, SNAPSHOT_WITHOUT_SAMPLES, snapshot

MESSAGES = MessageBuilder("bms", "pack")
BROKER_CONFIG = Path(__file__).parents[3] / "deploy/mosquitto/bms.conf"
DISCOVERY = "homeassistant/device/bms_pack/config"


def topics(messages: list[Message]) -> list[str]:
    """Return the topics, without the prefix of the pack."""
    return [message.topic.removeprefix("bms/pack/") for message in messages]


def test_broker_that_has_received_nothing_gets_all_live_messages():
    messages, published = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    assert topics(messages) == [
        "parameters",
        "forecast",
        "sensor/availability",
        "health",
        "info",
        DISCOVERY,
        "home_assistant",
    ]
    assert published.snapshot is CELL_SNAPSHOT


def test_retained_messages_have_qos_1_and_live_ones_qos_0():
    messages, _ = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    live_topics = {"parameters", "forecast", "home_assistant"}
    for message, topic in zip(messages, topics(messages), strict=True):
        assert (message.qos, message.retain) == ((0, False) if topic in live_topics else (1, True))
    assert all((m.qos, m.retain) == (1, True) for m in (*MESSAGES.birth_messages(), *MESSAGES.offline_messages()))


def test_states_must_be_delivered_and_exist_only_with_samples():
    [state] = MESSAGES.guaranteed_messages(CELL_SNAPSHOT, CELL_SNAPSHOT)
    assert (state.topic, state.qos, state.retain) == ("bms/pack/state", 1, False)
    assert topics(MESSAGES.guaranteed_messages(CELL_SNAPSHOT, CELL_SNAPSHOT)) == ["state"]
    assert MESSAGES.guaranteed_messages(CELL_SNAPSHOT, SNAPSHOT_WITHOUT_SAMPLES) == []


def test_events_must_be_delivered_and_precede_the_state():
    event, *_, state = MESSAGES.guaranteed_messages(None, CELL_SNAPSHOT)
    assert (event.topic, event.qos, event.retain) == ("bms/pack/event", 1, False)
    payload = json.loads(event.payload)
    assert (payload["name"], payload["time"]) == ("start", CELL_SNAPSHOT.health.publish_time)
    assert set(payload) == set(schema()["event"]["properties"])
    assert state.topic == "bms/pack/state"


def test_unchanged_messages_are_not_repeated():
    _, published = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    messages, _ = MESSAGES.live_messages(published, CELL_SNAPSHOT, NOW + 1.0)
    assert topics(messages) == []


def test_new_health_is_published():
    _, published = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    messages, _ = MESSAGES.live_messages(published, snapshot()._replace(forecast=CELL_SNAPSHOT.forecast), NOW + 1.0)
    assert topics(messages) == ["parameters", "health"]  # the estimate, which contains the parameters, is new, too


def test_a_forecast_is_published_once():
    _, published = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    assert MESSAGES.live_messages(published, CELL_SNAPSHOT, NOW + 1.0)[0] == []
    messages, _ = MESSAGES.live_messages(published, CELL_SNAPSHOT._replace(forecast=snapshot().forecast), NOW + 2.0)
    assert topics(messages) == ["forecast"]


def test_discovery_is_published_again_for_another_board_but_not_for_another_sample_rate():
    _, published = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    faster = CELL_SNAPSHOT.info.model_copy(update={"board": {**CELL_SNAPSHOT.info.board, "sample_rate_hz": "50"}})
    messages, published = MESSAGES.live_messages(published, CELL_SNAPSHOT._replace(info=faster), NOW + 1.0)
    assert topics(messages) == ["info"]
    swapped = CELL_SNAPSHOT.info.model_copy(update={"board": {**CELL_SNAPSHOT.info.board, "serial": "B2"}})
    messages, _ = MESSAGES.live_messages(published, CELL_SNAPSHOT._replace(info=swapped), NOW + 2.0)
    assert topics(messages) == ["info", DISCOVERY]


def test_parameters_are_published_from_the_first_sample_on():
    messages, published = MESSAGES.live_messages(PublishedState(), SNAPSHOT_WITHOUT_SAMPLES, NOW)
    assert not {"parameters", "home_assistant"} & set(topics(messages))
    messages, _ = MESSAGES.live_messages(published, CELL_SNAPSHOT, NOW + 1.0)
    assert topics(messages)[0] == "parameters"


def test_corrections_repeat_the_availabilities_published_last():
    _, silent = MESSAGES.live_messages(PublishedState(), snapshot(sensor_message="no board"), NOW)
    payloads = {m.topic: m.payload for m in MESSAGES.corrections(silent)}
    assert payloads == {"bms/pack/availability": b"online", "bms/pack/sensor/availability": b"offline"}
    assert topics(MESSAGES.corrections(PublishedState())) == ["availability"]


def test_state_has_the_fields_of_the_published_schema_and_null_for_missing_values():
    state = json.loads(MESSAGES.guaranteed_messages(CELL_SNAPSHOT, CELL_SNAPSHOT)[0].payload)
    schema_fields = schema()["state"]["properties"]
    assert set(state) == set(schema_fields) == set(schema()["state"]["required"])
    assert all("description" in field for field in schema_fields.values())
    assert state["temperature_c"] is None
    assert state["soc_percent"] == pytest.approx(50.0)
    assert state["crc_errors"] == 3


def test_every_payload_is_json_without_nan():
    messages, _ = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    for message in (*messages, *MESSAGES.guaranteed_messages(None, CELL_SNAPSHOT)):
        if message.topic != "bms/pack/sensor/availability":
            json.loads(message.payload, parse_constant=pytest.fail)


def test_messages_have_less_than_a_tenth_of_the_size_limit_of_the_example_broker():
    limit = re.search(r"^message_size_limit (\d+)$", BROKER_CONFIG.read_text(), re.MULTILINE)
    assert limit
    messages, _ = MESSAGES.live_messages(PublishedState(), CELL_SNAPSHOT, NOW)
    assert (
        max(
            len(m.payload)
            for m in (*messages, *MESSAGES.guaranteed_messages(None, CELL_SNAPSHOT), *MESSAGES.birth_messages())
        )
        < int(limit[1]) / 10
    )


def test_a_new_broker_gets_all_alarms_and_later_only_changed_ones():
    cleared = Alarm(
        name="soc_low",
        severity="warning",
        active=False,
        latched=False,
        since=None,
        value=None,
        limit=0.1,
        unit=None,
        text="",
    )
    other = cleared.model_copy(update={"name": "link_lost", "unit": "s", "limit": 10.0})
    raised = cleared.model_copy(
        update={"active": True, "since": CELL_SNAPSHOT.info.started, "value": 0.09, "text": "charge"}
    )
    before, after = CELL_SNAPSHOT._replace(alarms=(cleared, other)), CELL_SNAPSHOT._replace(alarms=(raised, other))
    messages, published = MESSAGES.live_messages(PublishedState(), before, NOW)
    assert {"alarm/soc_low", "alarm/link_lost"} <= set(topics(messages))
    assert MESSAGES.live_messages(published, before, NOW)[0] == []
    [message], published = MESSAGES.live_messages(published, after, NOW)
    assert (message.topic, message.qos, message.retain) == ("bms/pack/alarm/soc_low", 1, True)
    payload = json.loads(message.payload)
    assert payload == raised.model_dump()
    assert set(payload) == set(schema()["alarm"]["properties"])
    # the last message is the state
    assert [json.loads(m.payload)["name"] for m in MESSAGES.guaranteed_messages(before, after)[:-1]] == ["alarm_raised"]
    assert [json.loads(m.payload)["name"] for m in MESSAGES.guaranteed_messages(after, before)[:-1]] == [
        "alarm_cleared"
    ]


def test_retained_message_of_an_unmonitored_alarm_is_removed():
    assert not [m for m in MESSAGES.birth_messages() if "alarm" in m.topic]
    [message] = [
        m
        for m in MessageBuilder("bms", "pack", alarms=[a for a in ALARMS if a != "soc_low"]).birth_messages()
        if not m.payload
    ]
    assert (message.topic, message.qos, message.retain) == ("bms/pack/alarm/soc_low", 1, True)
