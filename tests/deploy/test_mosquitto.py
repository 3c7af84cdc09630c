"""The Mosquitto example, run by Mosquitto: passwords, no anonymous clients, access control."""

import asyncio
import contextlib
import os
import socket
import subprocess
import time
from collections.abc import Iterator

import aiomqtt
import pytest

from tests.patience import LONG_S

PASSWORDS = {"bms-estimator": "one", "dashboard": "two", "homeassistant": "three"}
LAST = {
    "bms/#": ("bms-estimator", "bms/pack/last"),
    "bms/+/request/+": ("homeassistant", "bms/pack/request/last"),
    "homeassistant/#": ("homeassistant", "homeassistant/last"),
    "homeassistant/status": ("homeassistant", "homeassistant/status"),
}
"""For each subscription who may publish to it what: once that has come, all before it has come or was denied."""


@pytest.fixture
def broker(program, deploy, free_port, tmp_path) -> Iterator[int]:
    """Port of a Mosquitto with the example's files, in a folder of its own."""
    mosquitto, passwd = program("mosquitto", "mosquitto"), program("mosquitto_passwd", "mosquitto")
    passwords = tmp_path / "bms.passwd"
    passwords.touch(mode=0o600)
    for user, password in PASSWORDS.items():
        subprocess.run([passwd, "-b", passwords, user, password], check=True, capture_output=True)
    (tmp_path / "bms.acl").write_text((deploy / "mosquitto/bms.acl").read_text())
    text = (deploy / "mosquitto/bms.conf").read_text()
    assert "listener 1883 127.0.0.1" in text
    text = text.replace("listener 1883", f"listener {free_port}").replace("/etc/mosquitto", str(tmp_path))
    if os.geteuid() == 0:
        text += "user root\n"  # the folder is root's
    (tmp_path / "bms.conf").write_text(text)
    with subprocess.Popen([mosquitto, "-c", tmp_path / "bms.conf"], stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_for_port(process, free_port)
            yield free_port
        finally:
            process.terminate()


def wait_for_port(process: "subprocess.Popen[str]", port: int) -> None:
    until = time.monotonic() + LONG_S
    while time.monotonic() < until:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.02)
    raise AssertionError("the broker does not listen")


def client(port: int, user: str) -> aiomqtt.Client:
    return aiomqtt.Client("127.0.0.1", port, username=user, password=PASSWORDS[user], timeout=LONG_S)


async def arrived(port: int, sender: str, topics: list[str], *, reader: str, subscription: str) -> list[str]:
    """Which of the messages that ``sender`` publishes come to ``reader``."""
    allowed, last = LAST[subscription]
    async with client(port, reader) as listening, client(port, sender) as sending, client(port, allowed) as ending:
        await listening.subscribe(subscription, qos=1)
        for topic in topics:
            await sending.publish(topic, b"x", qos=1)
        await ending.publish(last, b"x", qos=1)
        seen: list[str] = []
        async with asyncio.timeout(LONG_S):
            async for message in listening.messages:
                if message.topic.value == last:
                    break
                seen.append(message.topic.value)
    return seen


async def test_an_anonymous_client_is_refused(broker):
    with pytest.raises(aiomqtt.MqttError):
        async with aiomqtt.Client("127.0.0.1", broker, timeout=LONG_S):
            pass


async def test_a_wrong_password_is_refused(broker):
    with pytest.raises(aiomqtt.MqttError):
        async with aiomqtt.Client("127.0.0.1", broker, username="bms-estimator", password="two", timeout=LONG_S):
            pass


async def test_the_estimator_publishes_what_the_dashboard_sees(broker):
    topics = ["bms/pack/state", "bms/pack/sensor/availability", "bms/pack/availability"]
    assert await arrived(broker, "bms-estimator", topics, reader="dashboard", subscription="bms/#") == topics


async def test_the_estimator_publishes_nothing_but_its_own_topics(broker):
    topics = ["homeassistant/light/x/set", "other/topic", "homeassistant/device/pack/config"]
    seen = await arrived(broker, "bms-estimator", topics, reader="homeassistant", subscription="homeassistant/#")
    assert seen == ["homeassistant/device/pack/config"]


async def test_the_dashboard_may_not_ask_and_home_assistant_may(broker):
    topics = ["bms/pack/request/soc"]
    ask = {"reader": "bms-estimator", "subscription": "bms/+/request/+"}
    assert await arrived(broker, "dashboard", topics, **ask) == []
    assert await arrived(broker, "homeassistant", topics, **ask) == topics


async def test_nobody_but_the_estimator_may_publish_state(broker):
    for user in ("dashboard", "homeassistant"):
        assert await arrived(broker, user, ["bms/pack/state"], reader="dashboard", subscription="bms/#") == []


async def test_the_estimator_hears_the_birth_message(broker):
    seen = await arrived(broker, "homeassistant", [], reader="bms-estimator", subscription="homeassistant/status")
    assert seen == []  # but the last, without which it would not have ended


async def test_the_estimator_hears_who_else_writes_its_availabilities(broker):
    topics = ["bms/pack/availability", "bms/pack/sensor/availability", "bms/pack/request/last"]
    async with client(broker, "bms-estimator") as estimator:
        for topic in topics[:2]:
            await estimator.subscribe(topic)
        await estimator.subscribe("bms/+/request/+")
        async with client(broker, "homeassistant") as other:  # may not write the first two, so the estimator does
            for topic in topics[:2]:
                await other.publish(topic, b"forged", qos=1)
                await estimator.publish(topic, b"online", qos=1)
            await other.publish(topics[2], b"", qos=1)
        async with asyncio.timeout(LONG_S):
            heard = [await anext(estimator.messages) for _ in topics]
    assert [(m.topic.value, m.payload) for m in heard] == [
        (topics[0], b"online"),
        (topics[1], b"online"),
        (topics[2], b""),
    ]


async def test_a_message_that_would_fill_the_memory_goes_no_further(broker):
    async with client(broker, "bms-estimator") as estimator:
        await estimator.subscribe("bms/+/request/+")
        with contextlib.suppress(aiomqtt.MqttError):
            async with client(broker, "homeassistant") as flooder, asyncio.timeout(LONG_S):
                sending = asyncio.create_task(flooder.publish("bms/pack/request/state", bytes(5_000_000), qos=1))
                with pytest.raises(aiomqtt.MqttError):
                    await anext(flooder.messages)  # the broker ends the connection
        sending.cancel()
        async with client(broker, "homeassistant") as other:
            await other.publish("bms/pack/request/last", b"{}", qos=1)
        async with asyncio.timeout(LONG_S):
            assert (await anext(estimator.messages)).topic.value == "bms/pack/request/last"
