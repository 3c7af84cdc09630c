"""Reason codes of a broker in log and health."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog

from bms_estimator.mqtt.connection import BrokerConnectionError, ConnectOptions, DeliveryStats, brokers
from bms_estimator.mqtt.queue_sender import WINDOW
from bms_estimator.mqtt.reconnect_loop import BrokerConnector
from bms_estimator.settings.connections import BrokerSettings, MqttSettings
from bms_estimator.settings.sources.mqtt import SourceBroker
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.mqtt.sink import MqttSink
from bms_estimator.store.outbox import Outbox
from tests.mosquitto import Broker, Listener
from tests.mqtt.proxy import Proxy
from tests.patience import LONG_S, until
from tests.sinks.sink_helpers import STATE_TOPIC, Sink, assert_all_in_order, numbered_state, state_numbers
from tests.sinks.snapshots import CELL_SNAPSHOT, snapshot

IMPLEMENTATION_ERROR, NOT_AUTHORIZED, QUOTA_EXCEEDED, INVALID_PAYLOAD_FORMAT = 131, 135, 151, 153
"""Reason codes of MQTT 5. The first and the third are temporary."""


@pytest.fixture
def locked_broker(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that accepts no client, because it has no user."""
    with Broker(tmp_path, "allow_anonymous false") as broker:
        yield broker


@pytest.mark.parametrize("supports_5", [True, False])
async def test_wrong_password_is_reported_and_not_shown(
    locked_broker: Broker, tmp_path: Path, supports_5: bool
) -> None:
    (tmp_path / "password").write_text("s3cret")
    (tmp_path / "password").chmod(0o600)
    delivery = DeliveryStats()
    async with Proxy(locked_broker.port, supports_5=supports_5) as proxy:
        settings = MqttSettings(url=proxy.url, username="meter", password_file=tmp_path / "password")
        with structlog.testing.capture_logs() as logs:
            async with MqttSink(settings, "pack", RequestDispatcher(delivery), delivery, Outbox(None, max_messages=4)):
                await until(lambda: delivery.trouble)
    assert [line["event"] for line in logs] == ["broker not reachable"]
    assert logs[0]["reason"].startswith("Not authorized (135): name or password wrong")
    health = snapshot(delivery=delivery).health
    assert health.broker_trouble == logs[0]["reason"]
    assert "s3cret" not in f"{logs} {health}"


@pytest.mark.parametrize(("settings", "section"), [(MqttSettings, "mqtt"), (SourceBroker, "source")])
async def test_a_wrong_password_points_to_the_section_of_its_broker(
    locked_broker: Broker, settings: type[BrokerSettings], section: str
) -> None:
    options = ConnectOptions("reader", None, lambda _kind, _topic: None)
    connection = settings(url=locked_broker.url)
    with pytest.raises(BrokerConnectionError, match=f"see {section}.username, {section}.password_file"):
        async with BrokerConnector(connection)(brokers(connection)[0], options):
            pytest.fail("connected without a password")


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (142, "Session taken over (142): another client has the same name"),
        (139, "Server shutting down (139)"),
        (151, "Quota exceeded (151): the broker allows no more"),
        (141, "Keep alive timeout (141): it received nothing from this client for too long"),
    ],
)
async def test_reason_of_a_disconnect_is_reported(broker: Broker, code: int, expected: str) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Proxy(broker.port) as network, Listener(broker) as live, Sink(network.url) as sink:
            await live.wait("bms/pack/schema")
            network.send_disconnect(code)
            await until(lambda: sink.delivery.losses)
            assert logs[1]["event"] == "broker lost"  # after "broker connected"
            assert sink.delivery.losses == 1
            network.rejects_connections = False
            await until(lambda: len(live.all("bms/pack/schema")) == 2)
    assert logs[1]["reason"] == expected


@pytest.fixture
def limited_broker(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker with a maximum message size of 4 kB that handles one message at a time."""
    with Broker(tmp_path, "allow_anonymous true\nmax_packet_size 4000\nmax_inflight_messages 1") as broker:
        yield broker


async def test_message_above_the_size_limit_is_reported_and_not_sent(
    limited_broker: Broker,
) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Listener(limited_broker) as live, Sink(limited_broker.url, max_queued=1000) as sink:
            for number in range(100):
                sink.mqtt.publish(numbered_state(number))
            await until(lambda: sink.delivery.waiting == 0)
            await live.wait_json(STATE_TOPIC, lambda s: s["frames_received"] == 99)
            assert "bms/pack/schema" in sink.delivery.refused_topics
            assert sink.delivery.losses == 0
    assert_all_in_order(state_numbers(live), 100)
    assert {line["reason"] for line in logs if "topic" in line} == {
        "not allowed to write it: longer than the 4000 bytes that the broker takes"
    }


FAST_RETRY: Any = {"max_queued": 1000, "first_delay_s": 0.02}
RETAINED_TOPICS = {
    "bms/pack/availability",
    "bms/pack/schema",
    "bms/pack/sensor/availability",
    "bms/pack/health",
    "bms/pack/info",
    "homeassistant/device/bms_pack/config",
}


@pytest.mark.parametrize("code", [IMPLEMENTATION_ERROR, QUOTA_EXCEEDED])
async def test_temporarily_rejected_states_are_delivered_later_in_order(broker: Broker, code: int) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Proxy(broker.port) as network, Listener(broker) as live, Sink(network.url, **FAST_RETRY) as sink:
            for number in range(50):
                sink.mqtt.publish(numbered_state(number))
            await until(lambda: sink.delivery.waiting == 0)
            network.reject_code = code
            for number in range(50, 100):
                sink.mqtt.publish(numbered_state(number))
            await until(lambda: network.rejected.count(STATE_TOPIC) > WINDOW + 2)  # now only the oldest is retried
            assert STATE_TOPIC in sink.delivery.refused_topics
            network.reject_code = 0
            await until(lambda: sink.delivery.waiting == 0)
    assert_all_in_order(state_numbers(live), 100)
    assert (sink.delivery.drops, sink.delivery.losses) == (0, 0)
    assert len([line for line in logs if line.get("topic") == STATE_TOPIC]) == 1


async def test_temporarily_rejected_retained_message_is_sent_again_after_a_delay(broker: Broker) -> None:
    async with Proxy(broker.port) as network, Listener(broker) as live, Sink(network.url, max_queued=1000) as sink:
        network.reject_code = QUOTA_EXCEEDED
        sink.mqtt.publish(CELL_SNAPSHOT)
        await until(lambda: set(sink.delivery.refused_topics) >= RETAINED_TOPICS)
        assert set(network.rejected) >= RETAINED_TOPICS
        network.reject_code = 0
        async with asyncio.timeout(LONG_S):
            while sink.delivery.refused_topics:
                sink.mqtt.publish(CELL_SNAPSHOT)
                await asyncio.sleep(0.01)
        for topic in RETAINED_TOPICS:
            await live.wait(topic)


async def test_unchanged_retained_message_is_not_sent_again_with_each_snapshot_after_its_rejection(
    broker: Broker,
) -> None:
    async with Proxy(broker.port) as network, Sink(network.url, first_delay_s=LONG_S) as sink:
        network.reject_code = QUOTA_EXCEEDED
        for _ in range(20):
            rejected_before = network.rejected.count("bms/pack/health")
            sink.mqtt.publish(snapshot())
            await until(lambda: network.rejected.count("bms/pack/health") > rejected_before)  # noqa: B023 - awaited at once
        assert network.rejected.count("bms/pack/info") == network.rejected.count("bms/pack/schema") == 1
        network.disconnect_network()  # otherwise messages in backoff would delay the shutdown
        await until(lambda: sink.delivery.losses)


@pytest.mark.parametrize("code", [NOT_AUTHORIZED, INVALID_PAYLOAD_FORMAT])
async def test_permanently_rejected_state_is_dropped(broker: Broker, code: int) -> None:
    async with Proxy(broker.port) as network, Listener(broker) as live, Sink(network.url, max_queued=1000) as sink:
        await live.wait("bms/pack/schema")
        network.reject_code = code
        for number in range(50):
            sink.mqtt.publish(numbered_state(number))
        await until(lambda: sink.delivery.waiting == 0)
        assert network.rejected.count(STATE_TOPIC) == 50
        assert sink.delivery.drops == 50 + network.rejected.count("bms/pack/event")
        assert STATE_TOPIC in sink.delivery.refused_topics


async def test_lost_connection_is_logged_by_the_service_and_not_by_its_libraries(
    broker: Broker, capfd: pytest.CaptureFixture[str]
) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Proxy(broker.port) as network, Listener(broker) as live, Sink(network.url) as sink:
            for _ in range(3):
                messages_before, losses_before = len(live.messages), sink.delivery.losses
                sink.mqtt.publish(CELL_SNAPSHOT)
                await live.wait(STATE_TOPIC, skip=messages_before)
                network.disconnect_network()
                await until(lambda: sink.delivery.losses > losses_before)  # noqa: B023 - awaited at once
                network.rejects_connections = False
    assert {line["event"] for line in logs} <= {"broker connected", "broker lost", "broker not reachable"}
    assert capfd.readouterr().err == ""
