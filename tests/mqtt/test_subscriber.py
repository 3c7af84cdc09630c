"""Subscriber with a real broker: stored messages, and reports of lost connections."""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog

from bms_estimator.mqtt.topic_cache import MAX_BYTES, DeviceMessage, Subscriber
from bms_estimator.settings.connections import MqttSettings
from tests.mosquitto import Broker, Listener
from tests.mqtt.proxy import Proxy
from tests.patience import LONG_S, until
from tests.sinks.sink_helpers import Sink
from tests.sinks.snapshots import CELL_SNAPSHOT


class WatchedSubscriber:
    """Subscriber whose callbacks wake waiting tests.

    Attributes:
        received: Messages passed to the callback.
        lost_since_changes: Values of ``lost_since`` after each change of the connection.
    """

    def __init__(self, url: str, **options: Any) -> None:
        self.received: list[DeviceMessage] = []
        self.lost_since_changes: list[float | None] = []
        self._changed = asyncio.Event()
        settings = MqttSettings(url=url, **options)
        self.subscriber = Subscriber(settings, self._on_message, self._on_connection_change, first_delay_s=0.1)

    def _on_message(self, message: DeviceMessage) -> None:
        self.received.append(message)
        self._changed.set()

    def _on_connection_change(self) -> None:
        self.lost_since_changes.append(self.subscriber.lost_since)
        self._changed.set()

    async def until(self, condition: Any) -> None:
        """Wait until the condition is true. It is checked after each callback."""
        async with asyncio.timeout(LONG_S):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    def stored(self, device: str, topic: str) -> Any:
        """Return the stored payload of a topic, or None."""
        entry = self.subscriber.devices.get(device)
        return entry.topics.get(topic) if entry else None


@pytest.mark.parametrize("supports_5", [True, False], ids=["MQTT 5", "MQTT 3.1.1"])
async def test_published_messages_are_stored_and_passed_to_the_callback(broker: Broker, *, supports_5: bool) -> None:
    async with Proxy(broker.port, supports_5=supports_5) as proxy, Sink(broker.url) as sink:
        sink.mqtt.publish(CELL_SNAPSHOT)
        watched = WatchedSubscriber(proxy.url)
        async with watched.subscriber:
            await watched.until(lambda: watched.stored("pack", "health") and watched.stored("pack", "schema"))
            assert watched.subscriber.lost_since is None
            sink.mqtt.publish(CELL_SNAPSHOT)
            await watched.until(lambda: watched.stored("pack", "state"))
            assert CELL_SNAPSHOT.estimate
            assert watched.stored("pack", "state") == CELL_SNAPSHOT.estimate.model_dump(mode="json")
            assert watched.stored("pack", "availability") == "online"
            assert DeviceMessage("pack", "availability", "online") in watched.received
            await sink.mqtt.__aexit__(None, None, None)
            await watched.until(lambda: watched.stored("pack", "availability") == "offline")
    assert watched.subscriber.lost_messages == 0
    assert watched.lost_since_changes[0] is None
    assert watched.lost_since_changes[-1] is not None


async def test_invalid_messages_do_not_end_the_subscriber(broker: Broker) -> None:
    watched = WatchedSubscriber(broker.url)
    async with watched.subscriber, Listener(broker) as client:
        await watched.until(lambda: watched.lost_since_changes)
        await client.publish("bms/pack/state", b"\xff\xfe no json", qos=1)
        await client.publish("bms/no device/state", b"1", qos=1)
        await client.publish("bms/pack/info", bytes(2 * MAX_BYTES), qos=1)
        await client.publish("bms/pack/health", json.dumps({"uptime_s": 1}), qos=1)
        await watched.until(lambda: watched.stored("pack", "health"))
        assert "no json" in watched.stored("pack", "state")
        assert list(watched.subscriber.devices) == ["pack"]
        assert watched.stored("pack", "info") is None


async def test_subscriber_reconnects_to_a_restarted_broker(broker: Broker) -> None:
    watched = WatchedSubscriber(broker.url)
    async with watched.subscriber:
        await watched.until(lambda: watched.lost_since_changes == [None])  # it is connected
        async with Listener(broker) as client:
            await client.publish("bms/pack/state", b"1", qos=1)
        await watched.until(lambda: watched.stored("pack", "state") == 1)
        broker.stop()
        await watched.until(lambda: len(watched.lost_since_changes) == 2)
        lost_since = watched.lost_since_changes[1]
        assert lost_since is not None
        await until(lambda: watched.subscriber.trouble)
        assert watched.subscriber.lost_since == lost_since
        assert watched.stored("pack", "state") == 1
        broker.start()
        await watched.until(lambda: len(watched.lost_since_changes) == 3)
        assert watched.subscriber.lost_since is None
        assert watched.subscriber.trouble is None
        async with Listener(broker) as client:
            await client.publish("bms/pack/state", b"2", qos=1)
        await watched.until(lambda: watched.stored("pack", "state") == 2)


async def test_connection_counts_as_lost_from_the_start_until_the_first_connection(broker: Broker) -> None:
    broker.stop()
    watched = WatchedSubscriber(broker.url)
    async with watched.subscriber:
        since = watched.subscriber.lost_since
        assert since is not None
        await until(lambda: watched.subscriber.trouble)
        assert watched.subscriber.lost_since == since
        broker.start()
        await watched.until(lambda: watched.lost_since_changes == [None])


async def test_exception_of_the_message_callback_ends_the_subscriber(broker: Broker) -> None:
    def fail(_: DeviceMessage) -> None:
        raise ZeroDivisionError

    subscriber = Subscriber(MqttSettings(url=broker.url), fail)
    with pytest.RaisesGroup(ZeroDivisionError, flatten_subgroups=True):
        async with subscriber, Listener(broker) as client:
            await until(lambda: subscriber.lost_since is None)
            await client.publish("bms/pack/state", b"1", qos=1)
            await until(lambda: subscriber.lost_since is not None)


@pytest.fixture
def broker_with_passwords(tmp_path: Path) -> Iterator[Broker]:
    with Broker(tmp_path, "allow_anonymous false") as broker:
        yield broker


async def test_rejected_connection_is_reported_with_the_reason(broker_with_passwords: Broker) -> None:
    watched = WatchedSubscriber(broker_with_passwords.url)
    async with watched.subscriber:
        await until(lambda: watched.subscriber.trouble)
        assert "mqtt.password_file" in str(watched.subscriber.trouble)
        assert watched.subscriber.lost_since is not None


async def test_long_messages_are_dropped_with_one_log_line(broker: Broker) -> None:
    """By MQTT 3.1.1, a client cannot ask the broker to withhold long messages, and must drop them itself."""
    with structlog.testing.capture_logs() as lines:
        async with Proxy(broker.port, supports_5=False) as proxy, Listener(broker) as live:
            watched = WatchedSubscriber(proxy.url)
            async with watched.subscriber:
                await watched.until(lambda: watched.subscriber.lost_since is None)
                for number in range(5):
                    await live.publish(f"bms/pack/t{number}", b"x" * (MAX_BYTES + 1), qos=1)
                await live.publish("bms/pack/state", b"1", qos=1)
                await watched.until(lambda: watched.stored("pack", "state"))
                assert watched.subscriber.lost_messages == 5
    assert [line["reason"] for line in lines if line["event"] == "messages are dropped"] == ["longer than 65536 bytes"]


async def test_retained_payload_of_16_mib_neither_is_stored_nor_ends_the_connection(broker: Broker) -> None:
    async with Listener(broker, "other/#") as live:  # it does not receive its own messages
        await live.publish("bms/pack/info", bytes(16 * 2**20), qos=1, retain=True)
        await live.publish("bms/pack/state", b"1", qos=1, retain=True)
        watched = WatchedSubscriber(broker.url)
        async with watched.subscriber:
            await watched.until(lambda: watched.stored("pack", "state"))
            assert watched.stored("pack", "info") is None
            assert watched.subscriber.lost_since is None
