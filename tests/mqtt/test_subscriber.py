"""A subscriber with a real broker: its stored messages, and its report when the broker is gone."""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog

from bms_estimator.mqtt.subscriber import MAX_BYTES, Subscriber
from bms_estimator.mqtt.topic_cache import DeviceMessage
from bms_estimator.settings.mqtt import MqttSettings
from tests.mosquitto import MOSQUITTO, Broker, Listener
from tests.mqtt.proxy import Proxy
from tests.patience import LONG_S
from tests.sinks.service import Sink, until
from tests.sinks.snapshots import ONE


class Watch:
    """A subscriber whose callbacks wake waiting tests."""

    def __init__(self, url: str, **options: Any) -> None:
        self.heard: list[DeviceMessage] = []
        self.links: list[float | None] = []
        self._news = asyncio.Event()
        settings = MqttSettings(url=url, **options)
        self.subscriber = Subscriber(settings, self._hear, self._link, first_delay_s=0.1)

    def _hear(self, heard: DeviceMessage) -> None:
        self.heard.append(heard)
        self._news.set()

    def _link(self) -> None:
        self.links.append(self.subscriber.lost_since)
        self._news.set()

    async def until(self, condition: Any) -> None:
        async with asyncio.timeout(LONG_S):
            while not condition():
                self._news.clear()
                await self._news.wait()

    def kept(self, device: str, topic: str) -> Any:
        found = self.subscriber.devices.get(device)
        return found.topics.get(topic) if found else None


@pytest.mark.parametrize("knows_5", [True, False], ids=["MQTT 5", "MQTT 3.1.1"])
async def test_what_a_pack_publishes_is_kept_and_told(broker: Broker, *, knows_5: bool) -> None:
    async with Proxy(broker.port, knows_5=knows_5) as proxy, Sink(broker.url) as sink:
        sink.mqtt.publish(ONE)
        watch = Watch(proxy.url)
        async with watch.subscriber:
            await watch.until(lambda: watch.kept("pack", "health") and watch.kept("pack", "schema"))
            assert watch.subscriber.lost_since is None
            sink.mqtt.publish(ONE)
            await watch.until(lambda: watch.kept("pack", "state"))
            assert ONE.estimate
            assert watch.kept("pack", "state") == ONE.estimate.model_dump(mode="json")
            assert watch.kept("pack", "availability") == "online"
            assert DeviceMessage("pack", "availability", "online") in watch.heard
            await sink.mqtt.__aexit__(None, None, None)
            await watch.until(lambda: watch.kept("pack", "availability") == "offline")
    assert watch.subscriber.lost_messages == 0
    assert watch.links[0] is None
    assert watch.links[-1] is not None


async def test_garbage_is_kept_from_nobody_else_and_ends_nothing(broker: Broker) -> None:
    watch = Watch(broker.url)
    async with watch.subscriber, Listener(broker) as other:
        await watch.until(lambda: watch.links)
        await other.publish("bms/pack/state", b"\xff\xfe no json", qos=1)
        await other.publish("bms/no device/state", b"1", qos=1)
        await other.publish("bms/pack/info", bytes(2 * MAX_BYTES), qos=1)
        await other.publish("bms/pack/health", json.dumps({"uptime_s": 1}), qos=1)
        await watch.until(lambda: watch.kept("pack", "health"))
        assert "no json" in watch.kept("pack", "state")
        assert list(watch.subscriber.devices) == ["pack"]
        assert watch.kept("pack", "info") is None


async def test_a_broker_that_is_killed_and_comes_back(broker: Broker) -> None:
    watch = Watch(broker.url)
    async with watch.subscriber:
        await watch.until(lambda: watch.links == [None])
        async with Listener(broker) as other:
            await other.publish("bms/pack/state", b"1", qos=1)
        await watch.until(lambda: watch.kept("pack", "state") == 1)
        broker.stop()
        await watch.until(lambda: len(watch.links) == 2)
        lost_since = watch.links[1]
        assert lost_since is not None
        await until(lambda: watch.subscriber.trouble)
        assert watch.subscriber.lost_since == lost_since
        assert watch.kept("pack", "state") == 1
        broker.start()
        await watch.until(lambda: len(watch.links) == 3)
        assert watch.subscriber.lost_since is None
        async with Listener(broker) as other:
            await other.publish("bms/pack/state", b"2", qos=1)
        await watch.until(lambda: watch.kept("pack", "state") == 2)


async def test_before_there_is_a_broker_it_is_lost_since_the_start(broker: Broker) -> None:
    broker.stop()
    watch = Watch(broker.url)
    async with watch.subscriber:
        since = watch.subscriber.lost_since
        assert since is not None
        await until(lambda: watch.subscriber.trouble)
        assert watch.subscriber.lost_since == since
        broker.start()
        await watch.until(lambda: watch.links == [None])


async def test_a_fault_of_who_is_called_is_seen(broker: Broker) -> None:
    def fail(_: DeviceMessage) -> None:
        raise ZeroDivisionError

    subscriber = Subscriber(MqttSettings(url=broker.url), fail)
    with pytest.RaisesGroup(ZeroDivisionError, flatten_subgroups=True):
        async with subscriber, Listener(broker) as other:
            await until(lambda: subscriber.lost_since is None)
            await other.publish("bms/pack/state", b"1", qos=1)
            await until(lambda: subscriber.lost_since is not None)


@pytest.fixture
def broker_with_passwords(tmp_path: Path) -> Iterator[Broker]:
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
    broker = Broker(tmp_path, "allow_anonymous false").start()
    yield broker
    broker.stop()


async def test_a_broker_that_refuses_is_named_with_the_reason(broker_with_passwords: Broker) -> None:
    watch = Watch(broker_with_passwords.url)
    async with watch.subscriber:
        await until(lambda: watch.subscriber.trouble)
        assert "mqtt.password_file" in str(watch.subscriber.trouble)
        assert watch.subscriber.lost_since is not None


async def test_long_messages_are_dropped_with_one_log_line(broker: Broker) -> None:
    """A broker of MQTT 5 holds them back; one of MQTT 3.1.1 cannot."""
    with structlog.testing.capture_logs() as lines:
        async with Proxy(broker.port, knows_5=False) as proxy, Listener(broker) as live:
            watch = Watch(proxy.url)
            async with watch.subscriber:
                await watch.until(lambda: watch.subscriber.lost_since is None)
                for number in range(5):
                    await live.publish(f"bms/pack/t{number}", b"x" * (MAX_BYTES + 1), qos=1)
                await live.publish("bms/pack/state", b"1", qos=1)
                await watch.until(lambda: watch.kept("pack", "state"))
                assert watch.subscriber.lost_messages == 5
    assert [line["reason"] for line in lines if line["event"] == "messages are dropped"] == ["longer than 65536 bytes"]


async def test_a_retained_payload_of_16_mib_does_not_arrive(broker: Broker) -> None:
    async with Listener(broker, "other/#") as live:
        await live.publish("bms/pack/info", bytes(16 * 2**20), qos=1, retain=True)
        await live.publish("bms/pack/state", b"1", qos=1, retain=True)
        watch = Watch(broker.url)
        async with watch.subscriber:
            await watch.until(lambda: watch.kept("pack", "state"))
            assert watch.kept("pack", "info") is None
            assert watch.subscriber.lost_since is None
