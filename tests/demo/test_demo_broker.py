"""Broker of the demo: retained messages, last wills, its printed command and its shutdown."""

import asyncio
import contextlib
import shutil
import sys
from collections.abc import Mapping

import aiomqtt
import pytest

from bms_estimator.demo.demo import DemoBroker
from bms_estimator.model.errors import UserError
from tests.free_port import free_port
from tests.patience import LONG_S

RETAINED_TOPICS = ["bms/p/availability", "bms/p/sensor/availability", "bms/p/info", "homeassistant/device/p/config"]
BMS_TOPICS = RETAINED_TOPICS[:3]

# Program of a client with a last will. When its input is closed, it ends without a DISCONNECT.
CRASHING_CLIENT = """
import asyncio, os, sys, aiomqtt
async def main():
    will = aiomqtt.Will("bms/p/availability", b"offline", qos=1, retain=True)
    async with aiomqtt.Client("127.0.0.1", int(sys.argv[1]), will=will) as client:
        await client.publish("bms/p/availability", b"online", qos=1, retain=True)
        sys.stdin.read()
        os._exit(1)
asyncio.run(main())
"""


@pytest.fixture
def port() -> int:
    return free_port()


async def next_message(client: aiomqtt.Client) -> tuple[str, bytes, bool]:
    """Wait for a message. Return topic, payload and retain flag."""
    async with asyncio.timeout(LONG_S):
        message = await anext(aiter(client.messages))
    return message.topic.value, message.payload, message.retain


async def receive_retained(port: int, subscription: str) -> list[tuple[str, bytes]]:
    """Return topics and payloads of the retained messages that a new client receives, sorted.

    After the subscription the client sends a message to itself. Retained messages come before it.
    """
    retained = []
    own_topic = subscription.replace("#", "last").replace("+", "last")
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe(subscription, qos=1)
        await client.publish(own_topic, b"end", qos=1)
        while True:
            topic, payload, retain = await next_message(client)
            if not retain and payload == b"end":
                return sorted(retained)
            retained.append((topic, payload))


async def wait_for_retained(port: int, expected: Mapping[str, bytes]) -> None:
    """Wait until the retained messages are the expected ones, by topic.

    nats-server confirms a retained message shortly before new subscriptions receive it.
    """
    async with asyncio.timeout(LONG_S):
        while await receive_retained(port, "#") != sorted(expected.items()):
            pass


async def publish_all(client: aiomqtt.Client, port: int) -> None:
    """Publish a retained message on each topic of ``RETAINED_TOPICS``, and wait until subscribers receive them."""
    for topic in RETAINED_TOPICS:
        await client.publish(topic, topic, qos=1, retain=True)
    await wait_for_retained(port, {topic: topic.encode() for topic in RETAINED_TOPICS})


@pytest.mark.parametrize(
    ("subscription", "expected"),
    [
        ("bms/#", BMS_TOPICS),
        ("homeassistant/#", ["homeassistant/device/p/config"]),
        ("bms/+/availability", ["bms/p/availability"]),
        ("bms/p/info", ["bms/p/info"]),
        ("homeassistant/status", []),
    ],
)
async def test_subscriber_receives_each_matching_retained_message_once(port, subscription, expected):
    async with DemoBroker(port), aiomqtt.Client("127.0.0.1", port) as service:
        await publish_all(service, port)
        for other in ("bms/#", "homeassistant/#", "#"):  # overlapping subscriptions of another client
            await service.subscribe(other)
        assert [topic for topic, _ in await receive_retained(port, subscription)] == sorted(expected)


async def test_an_empty_retained_message_removes_the_retained_message_of_its_topic(port):
    async with DemoBroker(port), aiomqtt.Client("127.0.0.1", port) as service:
        await publish_all(service, port)
        await service.publish("bms/p/info", b"", qos=1, retain=True)
        await wait_for_retained(port, {topic: topic.encode() for topic in RETAINED_TOPICS if topic != "bms/p/info"})


async def test_will_of_a_crashed_client_is_published_and_retained(port):
    async with DemoBroker(port), aiomqtt.Client("127.0.0.1", port) as watcher:
        await watcher.subscribe("bms/p/availability", qos=1)
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CRASHING_CLIENT, str(port), stdin=asyncio.subprocess.PIPE
        )
        assert await next_message(watcher) == ("bms/p/availability", b"online", False)
        assert process.stdin
        process.stdin.close()
        assert await next_message(watcher) == ("bms/p/availability", b"offline", False)
        await process.wait()
        await wait_for_retained(port, {"bms/p/availability": b"offline"})


async def test_will_of_a_client_that_disconnects_is_not_published(port):
    async with DemoBroker(port), aiomqtt.Client("127.0.0.1", port) as watcher:
        await watcher.subscribe("bms/p/#", qos=1)
        will = aiomqtt.Will("bms/p/availability", b"offline", qos=1, retain=True)
        async with aiomqtt.Client("127.0.0.1", port, will=will) as service:
            await service.publish("bms/p/availability", b"online", qos=1, retain=True)
        await watcher.publish("bms/p/state", b"later", qos=1)
        assert await next_message(watcher) == ("bms/p/availability", b"online", False)
        assert await next_message(watcher) == ("bms/p/state", b"later", False)
        await wait_for_retained(port, {"bms/p/availability": b"online"})


async def test_a_port_in_use_is_an_error_but_without_a_given_port_a_free_one_is_used(port):
    async with DemoBroker(port):
        with pytest.raises(UserError, match=f"port {port}: in use"):
            DemoBroker(port)
        assert DemoBroker().port != port


async def test_the_printed_mosquitto_sub_command_shows_all_topics_of_the_packs(port):
    if shutil.which("mosquitto_sub") is None:
        pytest.skip("mosquitto_sub is not installed (apt install mosquitto-clients)")
    async with DemoBroker(port) as broker, aiomqtt.Client("127.0.0.1", port) as service:
        await publish_all(service, port)
        command = f"{broker.subscribe_command} -C 3"  # -C: exit after three messages
        process = await asyncio.create_subprocess_shell(command, stdout=asyncio.subprocess.PIPE)
        async with asyncio.timeout(LONG_S):
            shown, _ = await process.communicate()
        words = shown.decode().split()  # topic and payload in turn
        assert sorted(words[::2]) == sorted(BMS_TOPICS)


async def test_messages_received_before_the_shutdown_are_delivered(port):
    async with DemoBroker(port):
        listener = aiomqtt.Client("127.0.0.1", port)
        await listener.__aenter__()
        await listener.subscribe("bms/#")
        async with aiomqtt.Client("127.0.0.1", port) as client:
            for number in range(2000):
                await client.publish("bms/p/state", str(number))
    payloads = list[bytes]()
    with contextlib.suppress(aiomqtt.MqttError):  # the broker has gone
        async with asyncio.timeout(LONG_S):
            async for message in listener.messages:
                payloads.append(message.payload)
    with contextlib.suppress(aiomqtt.MqttError):
        await listener.__aexit__(None, None, None)
    assert [int(payload) for payload in payloads] == list(range(2000))
