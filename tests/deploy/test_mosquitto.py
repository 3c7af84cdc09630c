"""Example configuration of Mosquitto, run by Mosquitto: passwords, anonymous clients, access control."""

import asyncio
import contextlib
import os
import re
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import aiomqtt
import pytest

from tests.deploy.boot import commands_of_page
from tests.free_port import free_port
from tests.patience import LONG_S

PACKS = ("pack", "shed")
PASSWORDS = {"pack": "one", "shed": "four", "dashboard": "two", "homeassistant": "three"}
END_MESSAGES = {
    "bms/#": ("pack", "bms/pack/last"),
    "homeassistant/#": ("homeassistant", "homeassistant/last"),
    "bms/pack/request/+": ("homeassistant", "bms/pack/request/last"),
    "homeassistant/status": ("homeassistant", "homeassistant/status"),
}
"""Sender and topic of the last message for each subscription. When it arrives, earlier ones have arrived or were denied."""


@pytest.fixture
def broker(find_program, deploy, tmp_path) -> Iterator[int]:
    """Yield the port of a Mosquitto with the example's files."""
    port = free_port()
    mosquitto, passwd = find_program("mosquitto", "mosquitto"), find_program("mosquitto_passwd", "mosquitto")
    write_users(tmp_path, deploy, passwd)
    text = (deploy / "mosquitto/bms.conf").read_text()
    assert "listener 1883 127.0.0.1" in text
    text = text.replace("listener 1883", f"listener {port}").replace("/etc/mosquitto", str(tmp_path))
    with running(mosquitto, tmp_path / "bms.conf", text, port):
        yield port


def write_users(folder: Path, deploy: Path, passwd: str) -> None:
    """Write passwords and access lists, as the commands of docs/pack/integrations.md do."""
    passwords = folder / "bms.passwd"
    passwords.touch(mode=0o600)
    for user, password in PASSWORDS.items():
        subprocess.run([passwd, "-b", passwords, user, password], check=True, capture_output=True)
    template = (deploy / "mosquitto/pack.acl").read_text()
    packs = [template.replace("PACK", name) for name in PACKS]
    (folder / "bms.acl").write_text("".join([(deploy / "mosquitto/bms.acl").read_text(), *packs]))


@contextlib.contextmanager
def running(mosquitto: str, path: Path, text: str, port: int) -> Iterator[None]:
    """Run Mosquitto with the configuration ``text``, which is written to ``path``."""
    path.write_text(text + ("user root\n" if os.geteuid() == 0 else ""))  # the folder belongs to root
    with subprocess.Popen([mosquitto, "-c", path], stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_for_port(process, port)
            yield
        finally:
            process.terminate()


def wait_for_port(process: "subprocess.Popen[str]", port: int) -> None:
    deadline = time.monotonic() + LONG_S
    while time.monotonic() < deadline:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.02)
    raise AssertionError("the broker does not listen")


def client(port: int, user: str) -> aiomqtt.Client:
    return aiomqtt.Client("127.0.0.1", port, username=user, password=PASSWORDS[user], timeout=LONG_S)


async def received_by(port: int, sender: str, topics: list[str], *, reader: str, subscription: str) -> list[str]:
    """Publish to the topics as ``sender``. Return the topics whose messages reach the subscription of ``reader``."""
    end_sender_name, last_topic = END_MESSAGES[subscription]
    async with (
        client(port, reader) as subscriber,
        client(port, sender) as sender_client,
        client(port, end_sender_name) as end_sender,
    ):
        await subscriber.subscribe(subscription, qos=1)
        for topic in topics:
            await sender_client.publish(topic, b"x", qos=1)
        await end_sender.publish(last_topic, b"x", qos=1)
        received_topics: list[str] = []
        async with asyncio.timeout(LONG_S):
            async for message in subscriber.messages:
                if message.topic.value == last_topic:
                    break
                received_topics.append(message.topic.value)
    return received_topics


async def test_anonymous_client_is_rejected(broker):
    with pytest.raises(aiomqtt.MqttError):
        async with aiomqtt.Client("127.0.0.1", broker, timeout=LONG_S):
            pass


async def test_wrong_password_is_rejected(broker):
    with pytest.raises(aiomqtt.MqttError):
        async with aiomqtt.Client("127.0.0.1", broker, username="pack", password="two", timeout=LONG_S):
            pass


async def test_dashboard_receives_the_topics_of_a_pack(broker):
    topics = ["bms/pack/state", "bms/pack/sensor/availability", "bms/pack/availability"]
    assert await received_by(broker, "pack", topics, reader="dashboard", subscription="bms/#") == topics


async def test_pack_may_publish_only_its_own_discovery_under_homeassistant(broker):
    topics = ["homeassistant/light/x/set", "other/topic", "homeassistant/device/bms_pack/config"]
    received_topics = await received_by(broker, "pack", topics, reader="homeassistant", subscription="homeassistant/#")
    assert received_topics == ["homeassistant/device/bms_pack/config"]


async def test_pack_may_not_publish_the_topics_of_another_pack(broker):
    topics = ["bms/pack/state", "bms/pack/event", "bms/pack/availability", "bms/pack/response/soc", "bms/shed/state"]
    assert await received_by(broker, "shed", topics, reader="dashboard", subscription="bms/#") == ["bms/shed/state"]
    discovery = ["homeassistant/device/bms_pack/config", "homeassistant/device/bms_shed/config"]
    received_topics = await received_by(
        broker, "shed", discovery, reader="homeassistant", subscription="homeassistant/#"
    )
    assert received_topics == discovery[1:]


async def test_pack_receives_only_its_own_requests(broker):
    topics = ["bms/shed/request/publish_rate", "bms/pack/request/publish_rate"]
    async with client(broker, "pack") as subscriber, client(broker, "homeassistant") as requester:
        for topic in ("bms/+/request/+", "bms/pack/request/+"):
            await subscriber.subscribe(topic)
        for topic in topics:
            await requester.publish(topic, b"{}", qos=1)
        async with asyncio.timeout(LONG_S):
            assert (await anext(subscriber.messages)).topic.value == "bms/pack/request/publish_rate"


@pytest.fixture
def tls_port(find_program, deploy, tmp_path) -> Iterator[int]:
    """Yield the port of the listener for other machines, with certificates made by the commands of docs/pack/integrations.md."""
    port = free_port()
    mosquitto, passwd = find_program("mosquitto", "mosquitto"), find_program("mosquitto_passwd", "mosquitto")
    find_program("openssl", "openssl")
    commands = (
        commands_of_page("Certificates", page="integrations")
        .replace("broker.lan", "localhost")
        .replace("house", "pack")
    )
    # $new is set by the commands of the page: options of a new key
    commands += "openssl req -x509 $new -subj /CN=pack -keyout stranger.key -out stranger.crt\n"
    subprocess.run(["bash", "-ec", commands], cwd=tmp_path, check=True, capture_output=True)
    write_users(tmp_path, deploy, passwd)
    text = (deploy / "mosquitto/bms.conf").read_text().replace("/etc/mosquitto/certs", str(tmp_path))
    text = re.sub(
        r"(?m)^# (?=(listener|cafile|certfile|keyfile|require_certificate|use_identity_as_username) )", "", text
    )
    text = text.replace("listener 1883 127.0.0.1\n", "").replace("listener 8883", f"listener {port}")
    with running(mosquitto, tmp_path / "bms.conf", text.replace("/etc/mosquitto", str(tmp_path)), port):
        yield port


def with_certificate(port: int, folder: Path, name: str) -> aiomqtt.Client:
    """Return a client that identifies itself by the certificate ``name``."""
    files = {"certfile": str(folder / f"{name}.crt"), "keyfile": str(folder / f"{name}.key")}
    parameters = aiomqtt.TLSParameters(ca_certs=str(folder / "ca.crt"), cert_reqs=ssl.CERT_REQUIRED, **files)
    return aiomqtt.Client("localhost", port, tls_params=parameters, timeout=LONG_S)


async def test_certificate_decides_which_topics_a_pack_may_publish(tls_port, tmp_path):
    async with with_certificate(tls_port, tmp_path, "pack") as client:
        await client.subscribe("bms/pack/availability")
        for topic in ("bms/shed/availability", "bms/pack/availability"):
            await client.publish(topic, topic, qos=1)
        async with asyncio.timeout(LONG_S):
            assert (await anext(client.messages)).topic.value == "bms/pack/availability"


def test_clients_without_a_valid_certificate_are_rejected(tls_port, tmp_path):
    for name in (None, "stranger"):
        context = ssl.create_default_context(cafile=tmp_path / "ca.crt")
        if name:
            context.load_cert_chain(tmp_path / f"{name}.crt", tmp_path / f"{name}.key")
        line = socket.create_connection(("localhost", tls_port), LONG_S)
        rejected = pytest.raises((ssl.SSLError, ConnectionError))
        with line, rejected, context.wrap_socket(line, server_hostname="localhost") as secured:
            secured.recv(1)  # an accepting broker would wait for a first message


async def test_home_assistant_may_send_requests_and_the_dashboard_may_not(broker):
    topics = ["bms/pack/request/soc"]
    as_pack = {"reader": "pack", "subscription": "bms/pack/request/+"}
    assert await received_by(broker, "dashboard", topics, **as_pack) == []
    assert await received_by(broker, "homeassistant", topics, **as_pack) == topics


async def test_only_the_pack_may_publish_its_state(broker):
    for user in ("dashboard", "homeassistant"):
        assert await received_by(broker, user, ["bms/pack/state"], reader="dashboard", subscription="bms/#") == []


async def test_pack_receives_the_birth_message_of_home_assistant(broker):
    received_topics = await received_by(broker, "homeassistant", [], reader="pack", subscription="homeassistant/status")
    assert received_topics == []  # apart from the last message, which ends the reception


async def test_pack_receives_its_own_availability_topics_and_no_forged_ones(broker):
    topics = ["bms/pack/availability", "bms/pack/sensor/availability", "bms/pack/request/last"]
    async with client(broker, "pack") as pack:
        for topic in topics[:2]:
            await pack.subscribe(topic)
        await pack.subscribe("bms/pack/request/+")
        async with client(broker, "homeassistant") as other:  # it may not write the first two topics; the pack may
            for topic in topics[:2]:
                await other.publish(topic, b"forged", qos=1)
                await pack.publish(topic, b"online", qos=1)
            await other.publish(topics[2], b"", qos=1)
        async with asyncio.timeout(LONG_S):
            received = [await anext(pack.messages) for _ in topics]
    assert [(m.topic.value, m.payload) for m in received] == [
        (topics[0], b"online"),
        (topics[1], b"online"),
        (topics[2], b""),
    ]


async def test_message_of_5_mb_ends_its_connection_and_is_not_forwarded(broker):
    async with client(broker, "pack") as pack:
        await pack.subscribe("bms/pack/request/+")
        with contextlib.suppress(aiomqtt.MqttError):
            async with client(broker, "homeassistant") as flooder, asyncio.timeout(LONG_S):
                publication = asyncio.create_task(
                    flooder.publish("bms/pack/request/publish_rate", bytes(5_000_000), qos=1)
                )
                with pytest.raises(aiomqtt.MqttError):
                    await anext(flooder.messages)  # the broker ends the connection
        publication.cancel()
        async with client(broker, "homeassistant") as other:
            await other.publish("bms/pack/request/last", b"{}", qos=1)
        async with asyncio.timeout(LONG_S):
            assert (await anext(pack.messages)).topic.value == "bms/pack/request/last"
