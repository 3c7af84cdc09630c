"""Check of the MQTT brokers, with a real Mosquitto."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from bms_estimator.doctor.broker_check import check_broker
from bms_estimator.doctor.device_check import NOT_EXAMINED, SERIAL_REMEDY
from bms_estimator.doctor.finding import ExaminedPack, Finding, Level
from bms_estimator.process.state_folder import instance_lock
from tests.doctor.packs import subject
from tests.free_port import free_port
from tests.mosquitto import Broker, Listener, password_broker

READ = "topic read bms/house/request/+\n"
WRITE = "topic write bms/house/#\n"
READ_BACK = "topic read bms/house/availability\n"


@pytest.fixture
def restricted_broker(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Broker]:
    """Run a broker that denies everything to anonymous clients except the topics of ``request.param``."""
    access_list = tmp_path / "acl"
    access_list.write_text(request.param)
    access_list.chmod(0o600)
    with Broker(tmp_path, f"allow_anonymous true\nacl_file {access_list}") as broker:
        yield broker


def pack_at(folder: Path, *urls: str) -> ExaminedPack:
    return subject(folder, mqtt={"url": list(urls)})


def levels(findings: list[Finding]) -> list[Level]:
    return [finding.level for finding in findings]


def test_a_broker_without_restrictions_has_no_fault(tmp_path: Path, broker: Broker) -> None:
    connected, rights = check_broker(pack_at(tmp_path, broker.url))
    assert (connected.level, connected.text) == (Level.OK, f"{broker.url}: connected by MQTT 5")
    assert (rights.level, "may write and read bms/house/availability" in rights.text) == (Level.OK, True)


async def test_the_check_leaves_no_retained_message(tmp_path: Path, broker: Broker) -> None:
    await asyncio.to_thread(lambda: list(check_broker(pack_at(tmp_path, broker.url))))
    async with Listener(broker) as listener:
        await listener.publish("end")
        await listener.wait("end")
        assert [topic for topic, _, _ in listener.messages] == ["end"]


@pytest.mark.parametrize(
    ("restricted_broker", "text"),
    [
        (READ + READ_BACK, "may not write bms/house/availability: Not authorized"),
        (READ + WRITE, "bms/house/availability is not returned"),
    ],
    indirect=["restricted_broker"],
)
def test_a_denied_topic_is_a_fault(tmp_path: Path, restricted_broker: Broker, text: str) -> None:
    connected, rights = check_broker(pack_at(tmp_path, restricted_broker.url))
    assert connected.level is Level.OK
    assert rights.level is Level.FAULT
    assert text in rights.text
    assert "pack.acl" in rights.remedy


@pytest.mark.parametrize("restricted_broker", [READ + READ_BACK + WRITE], indirect=True)
def test_the_access_list_of_the_docs_suffices(tmp_path: Path, restricted_broker: Broker) -> None:
    assert levels(list(check_broker(pack_at(tmp_path, restricted_broker.url)))) == [Level.OK, Level.OK]


async def test_a_running_service_reports_denied_topics_and_is_not_disturbed(tmp_path: Path, broker: Broker) -> None:
    async with Listener(broker) as service:
        await service.publish("bms/house/availability", b"online", retain=True, qos=1)
        health = (
            b'{"refused_topics": ["bms/house/state"], "sensor_online": true, "suspects": ["pack.series = 8: 52.80 V"]}'
        )
        await service.publish("bms/house/health", health, retain=True, qos=1)
        findings = await asyncio.to_thread(lambda: list(check_broker(pack_at(tmp_path, broker.url))))
        await service.publish("end")
        await service.wait("end")
        assert service.all("bms/house/availability") == [b"online"]
    assert levels(findings) == [Level.OK, Level.FAULT, Level.OK, Level.WARNING]
    assert findings[3].text == "pack.series = 8: 52.80 V"
    assert findings[1].text == "the broker denies the running service: bms/house/state"


async def test_the_silent_device_of_a_running_service_is_a_fault(tmp_path: Path, broker: Broker) -> None:
    pack = pack_at(tmp_path, broker.url)
    with instance_lock(pack.state_folder, "house"):
        *_, unknown = await asyncio.to_thread(lambda: list(check_broker(pack)))
        async with Listener(broker) as service:
            health = b'{"refused_topics": [], "sensor_online": false, "sensor_message": "no message on x"}'
            await service.publish("bms/house/availability", b"online", retain=True, qos=1)
            await service.publish("bms/house/health", health, retain=True, qos=1)
            *_, silent = await asyncio.to_thread(lambda: list(check_broker(pack)))
    assert unknown == NOT_EXAMINED
    assert (silent.check, silent.level) == ("device", Level.FAULT)
    assert (silent.text, silent.remedy) == ("no samples arrive: no message on x", SERIAL_REMEDY)


def test_an_unreachable_broker_is_a_fault_unless_there_is_another_one(tmp_path: Path, broker: Broker) -> None:
    absent = f"mqtt://127.0.0.1:{free_port()}"
    (unreachable,) = check_broker(pack_at(tmp_path, absent))
    assert unreachable.level is Level.FAULT
    assert "refused" in unreachable.text
    assert levels(list(check_broker(pack_at(tmp_path, absent, broker.url)))) == [Level.WARNING, Level.OK, Level.OK]


def test_a_rejected_login_names_the_settings_of_the_login(tmp_path: Path) -> None:
    with password_broker(tmp_path) as broker:
        (rejected,) = check_broker(pack_at(tmp_path, broker.url))
    assert rejected.level is Level.FAULT
    assert "mqtt.username" in rejected.remedy
