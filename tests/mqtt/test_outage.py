"""Brokers that disappear, freeze or fall silent: no state is lost or out of order, and the next broker is used."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog

from bms_estimator.mqtt.client import Timeouts
from bms_estimator.mqtt.reconnect_loop import BrokerConnector
from bms_estimator.settings.connections import MqttSettings
from tests.mosquitto import Broker, Listener
from tests.mqtt.proxy import Proxy, read_packet
from tests.patience import LONG_S, until
from tests.sinks.sink_helpers import STATE_TOPIC, Sink, assert_all_in_order, numbered_state, state_numbers
from tests.sinks.snapshots import CELL_SNAPSHOT

SHORT_TIMEOUTS = Timeouts(connect_s=1.0, keepalive_s=1, acknowledge_s=1.0)
"""Short timeouts. On a busy machine a live broker may count as lost; the client then reconnects."""


def connect_options(url: str | tuple[str, ...], timeouts: Timeouts = SHORT_TIMEOUTS) -> dict[str, Any]:
    """Return the arguments of a ``Sink`` with these timeouts that drops no state."""
    return {"connect": BrokerConnector(MqttSettings(url=url), timeouts), "max_queued": 10_000}


@pytest.fixture
def second_broker(tmp_path: Path) -> Iterator[Broker]:
    (tmp_path / "second").mkdir()
    with Broker(tmp_path / "second") as broker:
        yield broker


@pytest.fixture(params=["MQTT 5", "MQTT 3.1.1"])
async def network(request: pytest.FixtureRequest, broker: Broker) -> AsyncIterator[Proxy]:
    """Start a proxy in front of the broker that passes MQTT 5 or rejects it."""
    async with Proxy(broker.port, supports_5=request.param == "MQTT 5") as proxy:
        yield proxy


async def test_states_published_during_outages_arrive_in_order(broker: Broker, network: Proxy) -> None:
    async with Listener(broker) as live, Sink(network.url, max_queued=10_000) as sink:
        for number in range(1000):
            sink.mqtt.publish(numbered_state(number))
            if number % 300 == 250:  # an outage of thirty states, three times
                await until(lambda: state_numbers(live))  # delivery has begun and is not finished
                network.disconnect_network()
                received_before = len(state_numbers(live))
            if number % 300 == 280:
                network.rejects_connections = False
                await until(lambda: len(state_numbers(live)) > received_before)  # noqa: B023 - awaited at once
        await until(lambda: sink.delivery.waiting == 0)
        await until(lambda: state_numbers(live)[-1] == 999)
    assert_all_in_order(state_numbers(live), 1000)
    assert sink.delivery.drops == 0


async def test_live_topics_overtake_a_backlog(broker: Broker, network: Proxy) -> None:
    network.disconnect_network()
    async with Listener(broker) as live, Sink(network.url, max_queued=10_000) as sink:
        # Mosquitto drops messages beyond 1000 that a slow subscriber has not received
        for number in range(900):
            sink.mqtt.publish(numbered_state(number))
        network.rejects_connections = False
        await until(lambda: len(set(state_numbers(live))) == 900)  # QoS 1 may deliver a state twice
    topics = [topic for topic, _, _ in live.messages]
    for topic in ("availability", "info", "health", "parameters", "home_assistant"):
        # at least half of the queued states arrive after it
        assert topics[topics.index(f"bms/pack/{topic}") :].count(STATE_TOPIC) >= 450, topic


async def test_queued_states_are_sent_before_offline_at_shutdown(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("QUEUE_DRAIN_TIMEOUT_S", "SHUTDOWN_TIMEOUT_S"):  # a busy machine needs seconds for the states
        monkeypatch.setattr(f"bms_estimator.sinks.mqtt.sink.{name}", LONG_S)
    async with Listener(broker) as live:
        async with Sink(broker.url, max_queued=10_000) as sink:
            await live.wait("bms/pack/availability")
            for number in range(300):
                sink.mqtt.publish(numbered_state(number))
        await live.wait("bms/pack/availability", lambda p: p == b"offline")
    assert state_numbers(live) == list(range(300))


async def test_silent_connection_is_replaced_by_the_next_broker(broker: Broker, second_broker: Broker) -> None:
    async with Proxy(broker.port) as silent, Listener(broker) as first, Listener(second_broker) as second:
        urls = (silent.url, second_broker.url)
        with structlog.testing.capture_logs() as logs:
            async with Sink(urls, **connect_options(urls)) as sink:
                for number in range(10):
                    sink.mqtt.publish(numbered_state(number))
                await first.wait_json(STATE_TOPIC, lambda s: s["frames_received"] == 9)
                await until(lambda: sink.delivery.waiting == 0)
                silent.drops_all = True
                for number in range(10, 30):
                    sink.mqtt.publish(numbered_state(number))
                await second.wait_json(STATE_TOPIC, lambda s: s["frames_received"] == 29)
                async with Listener(second_broker) as late:
                    assert await late.wait("bms/pack/availability") == b"online"
                # the first broker has published the will
                assert await first.wait("bms/pack/availability", lambda p: p == b"offline")
    assert_all_in_order(state_numbers(first) + state_numbers(second), 30)
    assert [line["url"] for line in logs if line["event"] == "broker connected"][:2] == [silent.url, second_broker.url]
    assert [line["url"] for line in logs if line["event"] == "broker lost"][:1] == [silent.url]


async def test_silent_connection_is_detected_without_traffic(broker: Broker) -> None:
    async with Proxy(broker.port) as silent, Listener(broker) as live:
        with structlog.testing.capture_logs() as logs:
            async with Sink(silent.url, **connect_options(silent.url, Timeouts(keepalive_s=1))) as sink:
                await live.wait("bms/pack/schema")
                silent.drops_all = True
                await until(lambda: any(line["event"] == "broker lost" for line in logs))
                silent.drops_all = False
                messages_before = len(live.messages)
                sink.mqtt.publish(CELL_SNAPSHOT)
                await live.wait(STATE_TOPIC, skip=messages_before)
                async with Listener(broker) as late:
                    assert await late.wait("bms/pack/availability") == b"online"
    assert next(line["reason"] for line in logs if line["event"] == "broker lost") == "the broker did not answer a ping"


async def test_connect_announces_a_keepalive_of_10_s() -> None:
    """A broker publishes the will 1.5 keepalive intervals after the last packet."""
    first_packet = asyncio.get_running_loop().create_future()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        packet = await read_packet(reader)
        if not first_packet.done():
            first_packet.set_result(packet)
        writer.close()

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    async with server, Sink(f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}"):
        _, header = (await asyncio.wait_for(first_packet, LONG_S)).split(b"MQTT", 1)
    assert int.from_bytes(header[2:4]) == 10  # bytes 0 and 1 are protocol version and flags


async def test_frozen_broker_receives_all_states_after_thawing(broker: Broker) -> None:
    async with Listener(broker) as live, Sink(broker.url, **connect_options(broker.url)) as sink:
        with structlog.testing.capture_logs() as logs:
            for number in range(10):
                sink.mqtt.publish(numbered_state(number))
            await live.wait_json(STATE_TOPIC, lambda s: s["frames_received"] == 9)
            broker.freeze()
            for number in range(10, 100):
                sink.mqtt.publish(numbered_state(number))
            await until(lambda: any(line["event"] == "broker not reachable" for line in logs))
            broker.thaw()
            await live.wait_json(STATE_TOPIC, lambda s: s["frames_received"] == 99)
            await until(lambda: sink.delivery.waiting == 0)
            async with Listener(broker) as late:
                await late.wait("bms/pack/availability", lambda p: p == b"online")
    assert_all_in_order(state_numbers(live), 100)
    assert any("no answer within" in line.get("reason", "") for line in logs)


async def test_frozen_broker_is_skipped_for_the_next_one(broker: Broker, second_broker: Broker) -> None:
    urls = (broker.url, second_broker.url)
    broker.freeze()
    with structlog.testing.capture_logs() as logs:
        async with Listener(second_broker) as live, Sink(urls, **connect_options(urls)):
            assert await live.wait("bms/pack/availability") == b"online"
    broker.thaw()
    events = [(line["event"], line["url"]) for line in logs if "url" in line]
    assert [events[0], next(each for each in events if each[0] == "broker connected")] == [
        ("broker not reachable", broker.url),
        ("broker connected", second_broker.url),
    ]


async def test_abandoned_attempt_does_not_close_the_next_connection(
    broker: Broker, caplog: pytest.LogCaptureFixture
) -> None:
    broker.freeze()
    with structlog.testing.capture_logs() as logs:
        async with Sink(broker.url, **connect_options(broker.url, Timeouts(connect_s=1.0))) as sink:
            await until(lambda: any(line["event"] == "broker not reachable" for line in logs))
            broker.thaw()
            async with Listener(broker) as live:
                await until(lambda: any(line["event"] == "broker connected" for line in logs))
                for number in range(20):
                    sink.mqtt.publish(numbered_state(number))
                await live.wait_json(STATE_TOPIC, lambda s: s["frames_received"] == 19)
                await until(lambda: sink.delivery.waiting == 0)
    assert not [line for line in logs if line["event"] == "broker lost"]
    assert not [record for record in caplog.records if record.name == "asyncio"], "no task is left that fails later"


@pytest.fixture
def state_denying_broker(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that rejects states."""
    (tmp_path / "acl").write_text(f"topic deny {STATE_TOPIC}\ntopic readwrite #\n")
    with Broker(tmp_path, f"allow_anonymous true\nacl_file {tmp_path / 'acl'}") as broker:
        yield broker


async def test_rejected_states_are_counted_and_do_not_block_other_topics(state_denying_broker: Broker) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Listener(state_denying_broker) as live, Sink(state_denying_broker.url, max_queued=1000) as sink:
            for number in range(100):
                sink.mqtt.publish(numbered_state(number))
            await until(lambda: sink.delivery.waiting == 0)
            await live.wait("bms/pack/health")
    assert (sink.delivery.drops, sink.delivery.refused_topics, live.all(STATE_TOPIC)) == (100, [STATE_TOPIC], [])
    warnings = [line for line in logs if line["log_level"] == "warning"]
    assert [line["topic"] for line in warnings] == [STATE_TOPIC]
    assert "Not authorized" in warnings[0]["reason"]
