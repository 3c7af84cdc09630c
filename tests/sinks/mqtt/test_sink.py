"""MQTT sink with a real broker: retained messages, availability, requests, rejections and TLS."""

import asyncio
import json
import subprocess
from collections.abc import AsyncIterator, Iterator, Mapping
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
import structlog
from aiomqtt import ProtocolVersion

from bms_estimator.demo.demo import DemoBroker
from bms_estimator.model.errors import UserError
from bms_estimator.model.events import events
from bms_estimator.mqtt.client import DEFAULT_TIMEOUTS, Client
from bms_estimator.mqtt.connection import (
    MAX_BYTES,
    MAX_WAITING,
    Connection,
    ConnectOptions,
    DeliveryStats,
    Message,
    brokers,
    check,
)
from bms_estimator.mqtt.receive_queue import ReceiveQueue
from bms_estimator.mqtt.reconnect_loop import BrokerConnector, ReconnectLoop
from bms_estimator.process.runtime import MAX_DELAY_S
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from bms_estimator.sinks.mqtt.sink import CORRECTION_S, MqttSink
from bms_estimator.store.outbox import Outbox
from tests.mosquitto import MOSQUITTO, Broker, Listener
from tests.mqtt.proxy import Proxy
from tests.patience import LONG_S, until
from tests.sinks.home_assistant.test_discovery import cleared_alarm
from tests.sinks.sink_helpers import Sink
from tests.sinks.snapshots import CELL_SNAPSHOT, snapshot

MAX_QUEUED = 4
"""Default size of the outbox of ``Sink`` [messages]."""
EVENTS_AT_START = len(events(None, CELL_SNAPSHOT))
"""Number of events that the first snapshot causes."""
RETAINED_TOPICS = ("info", "availability", "sensor/availability", "schema", "health")
DISCOVERY_TOPIC = "homeassistant/device/bms_pack/config"
CONNECT_OPTIONS = ConnectOptions("test", Message("bms/pack/availability", b"offline", 1, retain=True), lambda *_: None)
DYNAMIC_SECURITY = next(Path("/usr/lib").glob("*/mosquitto_dynamic_security.so"), None)
"""Plugin of Mosquitto by which it can reject subscriptions; None if it is not installed."""

RECORDED_PAUSES = 12
"""Number of pauses between attempts after which a reconnect loop is ended."""


async def fail_if_connected(_: Connection) -> None:
    raise AssertionError("there is no broker")


@pytest.fixture(params=["MQTT 5", "MQTT 3.1.1"])
async def url(request: pytest.FixtureRequest, broker: Broker) -> AsyncIterator[str]:
    """Return the URL of a proxy in front of the broker that passes MQTT 5 or rejects it."""
    async with Proxy(broker.port, supports_5=request.param == "MQTT 5") as proxy:
        yield proxy.url


async def test_topics_and_retained_flags_are_as_documented(broker: Broker, url: str) -> None:
    async with Listener(broker) as live:
        async with Sink(url) as sink:
            sink.mqtt.publish(CELL_SNAPSHOT)
            await live.wait("bms/pack/home_assistant")  # is published last
            async with Listener(broker) as late:
                for topic in RETAINED_TOPICS:
                    await late.wait(f"bms/pack/{topic}")
                await late.wait(DISCOVERY_TOPIC)
                retained_topics = {name for name, _, retain in late.messages if retain}
        await live.wait("bms/pack/availability", lambda payload: payload == b"offline")
    assert retained_topics == {f"bms/pack/{topic}" for topic in RETAINED_TOPICS} | {DISCOVERY_TOPIC}
    assert live.all("bms/pack/availability") == live.all("bms/pack/sensor/availability") == [b"online", b"offline"]
    assert {f"bms/pack/{topic}" for topic in ("state", "parameters", "home_assistant")} <= {
        name for name, _, _ in live.messages
    }
    assert sink.delivery == DeliveryStats()


async def test_retained_messages_are_sent_again_after_a_birth_message_of_home_assistant(broker: Broker) -> None:
    async with Listener(broker) as live, Sink(broker.url) as sink:
        sink.mqtt.publish(CELL_SNAPSHOT)
        await live.wait(DISCOVERY_TOPIC)
        messages_before = len(live.messages)
        await live.publish("homeassistant/status", b"online")
        while len(live.all(DISCOVERY_TOPIC)) < 2:
            sink.mqtt.publish(CELL_SNAPSHOT)
            await asyncio.sleep(0.05)
        for topic in RETAINED_TOPICS:
            await live.wait(f"bms/pack/{topic}", skip=messages_before)
        await live.wait("bms/pack/home_assistant", skip=messages_before)


async def test_restarted_broker_is_served_and_drops_are_counted(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    async with Sink(broker.url) as sink:
        for _ in range(5):
            sink.mqtt.publish(CELL_SNAPSHOT)
        assert (sink.delivery.drops, sink.delivery.waiting) == (EVENTS_AT_START + 5 - MAX_QUEUED, MAX_QUEUED)
        for _ in range(2):  # without persistence, each restarted broker is empty
            broker.start()
            try:
                async with Listener(broker) as live:
                    await live.wait(
                        "bms/pack/availability", lambda payload: payload == b"online"
                    )  # the sink is connected
                    sink.mqtt.publish(snapshot(delivery=sink.delivery))
                    for topic in (*RETAINED_TOPICS, "state"):
                        await live.wait(f"bms/pack/{topic}")
                    await live.wait_json("bms/pack/health", lambda health: health["publish_drops"] >= 1)
            finally:
                await asyncio.to_thread(broker.stop)


async def test_publish_returns_at_once_and_the_sink_closes_without_a_broker(tmp_path: Path) -> None:
    broker = Broker(tmp_path)  # it is never started
    async with Sink(broker.url) as sink:
        for _ in range(1000):
            sink.mqtt.publish(CELL_SNAPSHOT)
    assert sink.delivery.drops == EVENTS_AT_START + 1000 - MAX_QUEUED


async def test_abandoned_connection_leaves_no_callbacks(broker: Broker) -> None:
    """The connecting thread continues after its task is cancelled, and the event loop may be closing."""
    client = Client(
        {"hostname": "127.0.0.1", "port": broker.port}, ProtocolVersion.V5, CONNECT_OPTIONS, DEFAULT_TIMEOUTS, "mqtt"
    )
    tasks_before = asyncio.all_tasks()
    client.abandon()
    await asyncio.to_thread(client._client_connect)
    await asyncio.sleep(0)  # runs the callbacks of the thread
    assert client._client.socket() is None
    assert asyncio.all_tasks() == tasks_before


async def test_lost_broker_is_retried_at_least_every_30_s(tmp_path: Path) -> None:
    pauses: list[float] = []

    class RecordingLoop(ReconnectLoop):
        async def _pause(self, delay_s: float) -> None:
            pauses.append(delay_s)
            if len(pauses) == RECORDED_PAUSES:
                self.closing.set()

    settings = MqttSettings(url=Broker(tmp_path).url)
    await RecordingLoop(
        brokers(settings), CONNECT_OPTIONS, BrokerConnector(settings), fail_if_connected, DeliveryStats()
    ).run()
    assert max(pauses) <= MAX_DELAY_S == 30.0
    assert pauses[0] <= 5.0 < pauses[3]  # they grow
    assert len(set(pauses[-6:])) > 1, "clients of one broker do not come back all at once"


async def test_availability_is_online_after_a_half_open_connection(broker: Broker) -> None:
    async with Proxy(broker.port) as network, Listener(broker) as live, Sink(network.url) as sink:
        sink.mqtt.publish(CELL_SNAPSHOT)
        await live.wait(DISCOVERY_TOPIC)
        network.close_clients()
        async with asyncio.timeout(LONG_S):
            await network.half_open_ended.wait()  # it would otherwise end after 1.5 keepalive intervals
        messages_before = len(live.messages)
        sink.mqtt.publish(CELL_SNAPSHOT)
        await live.wait("bms/pack/state", skip=messages_before)
        async with Listener(broker) as late:
            assert await late.wait("bms/pack/availability") == b"online"
        assert live.all("bms/pack/availability") == [b"online", b"offline", b"online"]
        assert sink.delivery.corrections == 0, "the will came before the new online"


@pytest.mark.parametrize("forged", [b"offline", b"", b"nonsense"])
@pytest.mark.parametrize("topic", ["bms/pack/availability", "bms/pack/sensor/availability"])
async def test_availability_and_alarms_overwritten_by_another_client_are_corrected(
    broker: Broker, url: str, topic: str, forged: bytes
) -> None:
    alarm, alarm_topic = cleared_alarm("soc_low"), "bms/pack/alarm/soc_low"
    async with Listener(broker) as live, Sink(url) as sink:
        sink.mqtt.publish(CELL_SNAPSHOT._replace(alarms=(alarm,)))
        await live.wait(DISCOVERY_TOPIC)
        await live.publish(alarm_topic, b"another", qos=1, retain=True)
        await live.publish(topic, forged, qos=1, retain=True)
        await until(lambda: live.all(topic) == [b"online", forged, b"online"])
        async with Listener(broker) as late:
            assert await late.wait(topic) == b"online"
        await until(lambda: live.all(alarm_topic) == [alarm.json_bytes, b"another", alarm.json_bytes])
    assert sink.delivery.corrections == 1


async def test_will_at_broker_shutdown_is_not_counted_as_a_correction(broker: Broker) -> None:
    with structlog.testing.capture_logs() as logs:

        def connections() -> int:
            return sum(line["event"] == "broker connected" for line in logs)

        async with Sink(broker.url) as sink:
            async with Listener(broker) as live:
                sink.mqtt.publish(CELL_SNAPSHOT)
                await live.wait(f"bms/pack/{RETAINED_TOPICS[-1]}")  # is published last
            await asyncio.to_thread(broker.stop)
            await until(lambda: any(line["event"] == "broker not reachable" for line in logs))
            await asyncio.to_thread(broker.start)
            await until(lambda: connections() == 2)
    assert sink.delivery.corrections == 0
    assert not [line for line in logs if "somebody else" in line["event"]]


async def test_corrections_of_a_forged_availability_are_rate_limited(broker: Broker) -> None:
    loop = asyncio.get_running_loop()
    async with Listener(broker) as live, Sink(broker.url) as sink:
        sink.mqtt.publish(CELL_SNAPSHOT)
        await live.wait(DISCOVERY_TOPIC)
        begin_s = loop.time()
        for _ in range(200):
            await live.publish("bms/pack/availability", b"offline", qos=1, retain=True)
        await until(
            lambda: (
                (received := live.all("bms/pack/availability")).count(b"offline") == 200 and received[-1] == b"online"
            )
        )
        async with Listener(broker) as late:
            assert await late.wait("bms/pack/availability") == b"online"
    assert 1 <= sink.delivery.corrections <= 1 + (loop.time() - begin_s) / CORRECTION_S


async def test_request_gets_a_response(broker: Broker, url: str) -> None:
    async with Listener(broker) as live, Sink(url) as sink:
        sink.mqtt.publish(CELL_SNAPSHOT)
        await live.wait("bms/pack/availability")
        await live.publish("bms/pack/request/publish_rate", b'{"transaction": 7}', qos=1)
        response = await live.wait_json("bms/pack/response/publish_rate")
    assert response == {"status": "ok", "data": {"name": "publish_rate"}, "error": None, "transaction": 7}


async def test_retained_request_is_not_granted_on_connection(broker: Broker, url: str) -> None:
    async with Listener(broker) as live:
        await live.publish("bms/pack/request/set_soc", b"{}", qos=1, retain=True)
        async with Sink(url) as sink:
            await live.wait("bms/pack/availability")
            await live.publish("bms/pack/request/publish_rate", b"{}", qos=1)
            await live.wait("bms/pack/response/publish_rate")
    assert sink.requested == ["publish_rate"]
    assert sink.delivery.requests == {"retained": 1, "granted": 1}


async def test_retained_request_is_not_granted_while_connected(broker: Broker) -> None:
    async with Listener(broker) as live, Sink(broker.url) as sink:
        await live.wait("bms/pack/availability")
        await live.publish("bms/pack/request/set_soc", b"{}", qos=1, retain=True)
        await live.publish("bms/pack/request/publish_rate", b"{}", qos=1)
        await live.wait("bms/pack/response/publish_rate")
    assert sink.requested == ["publish_rate"]
    assert sink.delivery.requests == {"retained": 1, "granted": 1}


@pytest.mark.parametrize("name_bytes", [50_000, 65_535 - len("bms/pack/request/")])
async def test_request_with_a_long_name_does_not_end_the_service(broker: Broker, url: str, name_bytes: int) -> None:
    async with Listener(broker, "bms/pack/response/#") as live, Sink(url) as sink:
        async with Listener(broker, "bms/pack/availability") as started:
            await started.wait("bms/pack/availability")
        for name in ("x" * name_bytes, "é" * (name_bytes // 2), "nonsense"):
            await live.publish(f"bms/pack/request/{name}", b"{}", qos=1)
        await live.publish("bms/pack/request/publish_rate", b"{}", qos=1)
        await live.wait("bms/pack/response/publish_rate")
        assert len(live.messages) == 1  # requests with unknown names have no response
    assert sink.delivery.requests["granted"] == sink.delivery.requests["unknown"] == 1


async def test_flood_of_requests_is_counted_and_survived(broker: Broker, url: str) -> None:
    may_respond = asyncio.Event()

    async def respond_later(_: Mapping[str, Any]) -> Mapping[str, Any]:
        await may_respond.wait()
        return {}

    async with Listener(broker, "bms/pack/response/#") as live, Sink(url) as sink:
        sink.requests.register("current_zero", respond_later)
        async with Listener(broker, "bms/pack/availability") as started:
            await started.wait("bms/pack/availability")
        with structlog.testing.capture_logs() as logs:
            await live.publish("bms/pack/request/current_zero", qos=1)
            for _ in range(20):  # longer than a request may be
                await live.publish("bms/pack/request/none", b"x" * 1_000_000, qos=1)
            for _ in range(3 * MAX_WAITING):
                await live.publish("bms/pack/request/none", b"x" * 4000, qos=1)
            await until(lambda: sink.delivery.requests["overflow"] > MAX_WAITING)
            may_respond.set()
            await live.wait("bms/pack/response/current_zero")
        assert len(logs) < 10
        while not live.all("bms/pack/response/publish_rate"):  # the first requests may still be dropped
            await live.publish("bms/pack/request/publish_rate", qos=1)
            await asyncio.sleep(0.1)


def test_receive_queue_drops_long_messages_and_is_bounded_in_bytes() -> None:
    delivery = DeliveryStats()
    inbox = ReceiveQueue(RequestDispatcher(delivery).count_refusal, MAX_BYTES, MAX_WAITING)
    for length in (MAX_BYTES - 1, 2 * MAX_BYTES) * (2 * MAX_WAITING):
        inbox.put_nowait(aiomqtt.Message("t", bytes(length), 1, retain=False, mid=1, properties=None))
    waiting = [inbox.get_nowait() for _ in range(inbox.qsize())]
    assert sum(len(message.payload) for message in waiting) <= MAX_WAITING * MAX_BYTES
    assert delivery.requests == {"too_long": 2 * MAX_WAITING, "overflow": MAX_WAITING}


async def test_internal_error_publishes_offline_and_is_raised(broker: Broker) -> None:
    async with Listener(broker) as live:
        sink = await Sink(broker.url).__aenter__()
        await live.wait("bms/pack/availability")
        sink.mqtt.publish(CELL_SNAPSHOT._replace(info=None))  # type: ignore[arg-type]
        await live.wait("bms/pack/availability", lambda p: p == b"offline")
        with pytest.raises(ExceptionGroup) as fault:
            await sink.__aexit__()
    assert fault.value.split(AttributeError)[1] is None  # it contains no other exception


async def test_sink_works_with_the_demo_broker_without_mqtt_5() -> None:
    async with DemoBroker() as broker, aiomqtt.Client("127.0.0.1", broker.port) as client, Sink(broker.url) as sink:
        await client.subscribe([("bms/pack/state", 0), ("bms/pack/response/publish_rate", 1)])
        sink.mqtt.publish(CELL_SNAPSHOT)
        async with asyncio.timeout(LONG_S):
            assert (await anext(client.messages)).topic.value == "bms/pack/state"
            await client.publish("bms/pack/request/publish_rate", qos=1)
            assert (await anext(client.messages)).topic.value == "bms/pack/response/publish_rate"


@pytest.fixture
def denying_broker(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that denies all topics. Mosquitto reports a denial only to MQTT 5 clients that publish."""
    (tmp_path / "acl").write_text("topic read nothing\n")
    with Broker(tmp_path, f"allow_anonymous true\nacl_file {tmp_path / 'acl'}") as broker:
        yield broker


async def test_silent_denial_is_detected_by_the_missing_echo_of_online(denying_broker: Broker) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Proxy(denying_broker.port, supports_5=False) as proxy, Sink(proxy.url, echo_s=0.5) as sink:
            await until(lambda: sink.delivery.refused_topics)
            assert snapshot(delivery=sink.delivery).health.refused_topics == ["bms/pack/availability"]
    assert [line["topic"] for line in logs if line["log_level"] == "warning"] == ["bms/pack/availability"]


async def test_denied_retained_topics_are_logged_once(
    denying_broker: Broker,
) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Sink(denying_broker.url) as sink:
            sink.mqtt.publish(CELL_SNAPSHOT)
            await until(lambda: len(sink.delivery.refused_topics) > len(RETAINED_TOPICS) + 2)
            sink.mqtt.publish(snapshot())
    denied_topics = [line["topic"] for line in logs if line["log_level"] == "warning"]
    assert sorted(denied_topics) == sorted(
        [*(f"bms/pack/{topic}" for topic in (*RETAINED_TOPICS, "state", "event")), DISCOVERY_TOPIC]
    )
    assert sink.delivery.refused_topics == denied_topics


async def test_late_echo_of_online_removes_the_reported_denial(broker: Broker) -> None:
    with structlog.testing.capture_logs() as logs:
        async with Sink(broker.url, echo_s=0.0) as sink, Listener(broker) as live:
            await live.wait("bms/pack/availability")
            await until(lambda: not sink.delivery.refused_topics)
    assert [line["topic"] for line in logs if line["log_level"] == "warning"] == ["bms/pack/availability"]


@pytest.fixture
def broker_without_requests(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that rejects subscriptions to requests."""
    if MOSQUITTO is None or DYNAMIC_SECURITY is None:
        pytest.skip("mosquitto with its dynamic security is not installed (apt-get install mosquitto)")
    acls = [
        {"acltype": "subscribeLiteral", "topic": "bms/+/request/#", "priority": 1, "allow": False},
        {"acltype": "subscribePattern", "topic": "bms/pack/request/+", "priority": 1, "allow": False},
        {"acltype": "subscribePattern", "topic": "#", "priority": 0, "allow": True},
    ]
    acl = {
        "defaultACLAccess": {"publishClientSend": True, "publishClientReceive": True, "subscribe": True},
        "groups": [{"groupname": "all", "roles": [{"rolename": "no requests"}]}],
        "roles": [{"rolename": "no requests", "acls": acls}],
        "anonymousGroup": "all",
        "clients": [],
    }
    (tmp_path / "acl.json").write_text(json.dumps(acl))
    (tmp_path / "acl.json").chmod(0o600)
    extra = f"allow_anonymous true\nplugin {DYNAMIC_SECURITY}\nplugin_opt_config_file {tmp_path / 'acl.json'}"
    with Broker(tmp_path, extra) as broker:
        yield broker


@pytest.mark.parametrize("supports_5", [True, False])
async def test_denied_subscription_is_reported_in_log_and_health(
    broker_without_requests: Broker, supports_5: bool
) -> None:
    async with (
        Proxy(broker_without_requests.port, supports_5=supports_5) as proxy,
        Listener(broker_without_requests) as live,
    ):
        with structlog.testing.capture_logs() as logs:
            async with Sink(proxy.url) as sink:
                await live.wait("bms/pack/availability")
                sink.mqtt.publish(snapshot(delivery=sink.delivery))
                health = await live.wait_json("bms/pack/health")
    assert health["refused_topics"] == ["bms/pack/request/+"]
    assert [line["topic"] for line in logs if line["log_level"] == "warning"] == ["bms/pack/request/+"]


@pytest.fixture
def secure_broker(tmp_path: Path) -> Iterator[Broker]:
    """Start a broker that requires user name, password and TLS; its folder has the certificate and the password."""
    key, certificate, passwords = (tmp_path / name for name in ("key.pem", "cert.pem", "passwords"))
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
         "-keyout", key, "-out", certificate, "-days", "2", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "meter", "s3cret"], check=True, capture_output=True)
    (tmp_path / "secret").write_text("s3cret\n")
    security = f"allow_anonymous false\npassword_file {passwords}\ncertfile {certificate}\nkeyfile {key}"
    with Broker(tmp_path, security) as broker:
        yield broker


async def test_sink_connects_with_user_name_password_and_tls(secure_broker: Broker, tmp_path: Path) -> None:
    certificate = tmp_path / "cert.pem"
    settings = MqttSettings(
        url=f"mqtts://127.0.0.1:{secure_broker.port}",
        username="meter",
        password_file=tmp_path / "secret",
        ca_file=certificate,
    )
    tls = aiomqtt.TLSParameters(ca_certs=str(certificate))
    async with (
        Listener(secure_broker, "bms/#", username="meter", password="s3cret", tls_params=tls) as live,
        MqttSink(
            settings, "pack", RequestDispatcher(DeliveryStats()), DeliveryStats(), Outbox(None, max_messages=MAX_QUEUED)
        ) as mqtt,
    ):
        mqtt.publish(CELL_SNAPSHOT)
        await live.wait("bms/pack/state")


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"url": "mqtt://host:99999"}, "mqtt.url"),
        ({"url": f"mqtt://{'a' * 64}.local"}, "mqtt.url = mqtt://a+.local: .*too long"),
        ({"url": "mqtt://broker..local"}, r"mqtt.url = mqtt://broker\.\.local: .*empty"),
        ({"url": "mqtt://[::1"}, r"mqtt.url = mqtt://\[::1: "),
        ({"password_file": Path("/nonexistent/password")}, "mqtt.password_file = /nonexistent/password"),
        ({"url": "mqtts://host", "ca_file": Path("/nonexistent/ca.pem")}, "mqtt.ca_file = /nonexistent/ca.pem"),
    ],
)
def test_error_names_the_unusable_setting(changes: dict[str, Any], error: str) -> None:
    with pytest.raises(UserError, match=error):
        check(MqttSettings(**changes))
