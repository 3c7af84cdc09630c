"""Check of the MQTT brokers: connection, and permission to publish and read the pack's topics.

The only message that is published is ``offline``, not retained, on the pack's availability topic, and only while no service
of the pack is online. A test of other topics would send false values to their subscribers. The health message
of a running service reports denied topics and missing samples.
"""

import asyncio
import contextlib
import json
import secrets
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace

from bms_estimator.doctor import device_check
from bms_estimator.doctor.finding import ExaminedPack, Finding, Level, fault, ok, warning
from bms_estimator.mqtt.client import Timeouts
from bms_estimator.mqtt.connection import (
    Broker,
    BrokerConnectionError,
    Connection,
    ConnectOptions,
    LoginError,
    Message,
    brokers,
)
from bms_estimator.mqtt.reconnect_loop import BrokerConnector
from bms_estimator.process.systemd import is_unreadable_credential
from bms_estimator.settings.connections import BrokerSettings
from bms_estimator.sinks.mqtt.messages import AVAILABILITY

NAME = "broker"
RETAINED_TIMEOUT_S = 2.0
"""Time within which a broker sends retained messages after a subscription [s]. If ``online`` of a running service arrived
later, the check would publish ``offline`` to its subscribers."""
ECHO_TIMEOUT_S = 2.0
"""Time within which a broker returns a message [s]."""
TIMEOUTS = Timeouts(connect_s=4.0, acknowledge_s=3.0)
ACCESS_LIST_REMEDY = "correct the broker's access list, for Mosquitto: deploy/mosquitto/pack.acl"
"""Remedy for a denied topic."""


def check_broker(subject: ExaminedPack) -> Iterator[Finding]:
    """Yield findings on the connection to brokers and fleet server, on denied topics, and on the health of a running service.

    Raises:
        UserError: A setting of ``[mqtt]`` or ``[edge]`` cannot be used.
    """
    pack = subject.settings.pack.name
    if mqtt := subject.settings.mqtt:
        findings = list(_check_section(subject, mqtt, f"{mqtt.base_topic}/{pack}"))
        yield from findings
        if subject.is_running and all(finding.check != device_check.NAME for finding in findings):
            yield device_check.NOT_EXAMINED
    if edge := subject.settings.edge:
        yield from _check_section(subject, edge, None)


def _check_section(subject: ExaminedPack, settings: BrokerSettings, pack_topic: str | None) -> Iterator[Finding]:
    """Yield the findings on the brokers of a section.

    Args:
        subject: The pack.
        settings: The section.
        pack_topic: Topic of the pack, below which rights are checked; None: rights are not checked.
    """
    if settings.password_file and is_unreadable_credential(settings.password_file):
        text = f"{', '.join(settings.urls)}: not checked, because only the running service can read its password"
        unit = subject.unit.name if subject.unit else "bms-estimator"
        yield warning(NAME, text, f"read the log of the service: journalctl -u {unit}")
        return
    remedy = device_check.silence_remedy(subject)
    yield from asyncio.run(_examine_all(settings, pack_topic, remedy))


async def _examine_all(settings: BrokerSettings, pack_topic: str | None, silence_remedy: str) -> list[Finding]:
    """Return the findings on all brokers, which are examined at the same time."""
    checks = (_examine(settings, broker, pack_topic, silence_remedy) for broker in brokers(settings))
    results = await asyncio.gather(*checks)
    has_connection = any(connection.level is Level.OK for connection, *_ in results)
    findings = []
    for connection, *rights in results:
        if connection.level is Level.FAULT and has_connection:  # the service uses a broker that it can reach
            connection = replace(connection, level=Level.WARNING)  # noqa: PLW2901
        findings += [connection, *rights]
    return findings


async def _examine(
    settings: BrokerSettings, broker: Broker, pack_topic: str | None, silence_remedy: str
) -> list[Finding]:
    """Return the findings on one broker: first on the connection, then on the rights."""
    options = ConnectOptions(f"bms-doctor-{secrets.token_hex(4)}", will=None, on_message_lost=lambda *_: None)
    try:
        async with BrokerConnector(settings, TIMEOUTS)(broker, options) as connection:
            findings = [ok(NAME, f"{broker.url}: connected by {connection.protocol}")]
            if pack_topic:
                findings += [finding async for finding in _examine_rights(connection, pack_topic, silence_remedy)]
            return findings
    except BrokerConnectionError as error:
        section = settings.section
        remedy = (
            f"correct {section}.username and the password in {section}.password_file"
            if isinstance(error, LoginError)
            else f"start the broker, or correct {section}.url: nc -vz {broker.host} {broker.port}"
        )
        return [fault(NAME, f"{broker.url}: {error}", remedy)]


async def _examine_rights(connection: Connection, pack_topic: str, silence_remedy: str) -> AsyncIterator[Finding]:
    """Yield findings on the rights to the pack's topics, or on the health of a running service."""
    topic = f"{pack_topic}/{AVAILABILITY}"
    denied = await connection.subscribe(f"{pack_topic}/request/+", [topic, f"{pack_topic}/health"])
    denied.pop(f"{pack_topic}/health", None)  # the service itself need not read it
    for name, reason in denied.items():
        yield fault(NAME, f"may not read {name}: {reason}", ACCESS_LIST_REMEDY)
    retained = await _retained_messages(connection, {topic, f"{pack_topic}/health"})
    if retained.get(topic) == b"online":
        for finding in _health_of_service(retained.get(f"{pack_topic}/health", b""), silence_remedy):
            yield finding
        return
    rejection = await connection.publish(Message(topic, b"offline", 1, retain=False))
    if rejection:
        yield fault(NAME, f"may not write {topic}: {rejection.reason}", ACCESS_LIST_REMEDY)
    elif topic not in denied and not await _is_echoed(connection, topic):
        yield fault(NAME, f"{topic} is not returned: it may not be read, or not be written", ACCESS_LIST_REMEDY)
    elif not denied:
        yield ok(NAME, f"may write and read {topic}, and read {pack_topic}/request/+")


async def _retained_messages(connection: Connection, topics: set[str]) -> dict[str, bytes]:
    """Return the payloads of the retained messages of ``topics``."""
    retained = dict[str, bytes]()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(RETAINED_TIMEOUT_S):
            while not topics <= retained.keys():
                message = await connection.receive()
                retained[message.topic] = message.payload
    return retained


async def _is_echoed(connection: Connection, topic: str) -> bool:
    """Return True if a message on ``topic`` arrives."""
    try:
        async with asyncio.timeout(ECHO_TIMEOUT_S):
            while (await connection.receive()).topic != topic:
                pass
    except TimeoutError:
        return False
    return True


def _health_of_service(payload: bytes, silence_remedy: str) -> Iterator[Finding]:
    """Yield findings from the health message of the running service: denied topics, samples and suspected faults."""
    try:
        health = json.loads(payload)
        topics, is_silent = health["refused_topics"], not health["sensor_online"]
    except (ValueError, KeyError, TypeError):  # its health may not be read
        yield ok(NAME, "the pack's service is online; its log names denied topics")
        return
    if topics:
        yield fault(NAME, f"the broker denies the running service: {', '.join(topics)}", ACCESS_LIST_REMEDY)
    else:
        yield ok(NAME, "the pack's service is online; the broker denies no topic")
    if is_silent:
        yield fault(device_check.NAME, f"no samples arrive: {health.get('sensor_message')}", silence_remedy)
    else:
        yield ok(device_check.NAME, "samples arrive at the running service; not opened")
    for text in health.get("suspects", ()):
        yield warning(device_check.NAME, text, "correct the settings or the wiring, then restart the service")
