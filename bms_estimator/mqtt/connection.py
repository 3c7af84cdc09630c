"""Interface of a connection to a broker, implemented by ``client``: its messages, and the broker's address, passwords and certificates."""

import re
import ssl
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol
from urllib.parse import urlsplit

from bms_estimator.model.config_file import without_secrets
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.systemd import credential_path
from bms_estimator.settings.connections import BrokerSettings

MAX_WAITING = 100
"""Default of ``ConnectOptions.max_waiting``."""
MAX_BYTES = 16_384
"""Default of ``ConnectOptions.max_bytes`` [bytes]."""


@dataclass
class DeliveryStats:
    """Counters of a pack's sent messages and received requests since start; topic ``health`` publishes them."""

    drops: int = 0
    """States and events dropped because the queue was full or the broker rejected them."""
    waiting: int = 0
    """States and events that the broker has not acknowledged yet."""
    store_trouble: Callable[[], str] = field(default=str, compare=False)
    """Function that returns the reason for which queued messages and history cannot be stored. The reason is empty if
    they can be stored, and without a database."""
    losses: int = 0
    """Number of lost connections."""
    trouble: str | None = None
    """Reason for the lost or failed connection; None while connected, and before the first attempt."""
    refused_topics: list[str] = field(default_factory=list)
    """Topics that the broker denies, as far as it reports denials."""
    corrections: int = 0
    """Availability messages of other clients that were corrected."""
    requests: Counter[str] = field(default_factory=Counter)
    """Number of requests by result."""


OnResult = Callable[[str], object]
"""Callback for the result of a message: the reason why the message was rejected or lost, or "" if it was acknowledged."""


class Message(NamedTuple):
    """MQTT message."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class QueuedMessage(NamedTuple):
    """Message on its way to the broker."""

    number: int
    """Position in the queue; consecutive messages have consecutive numbers."""
    message: Message


class BrokerConnectionError(Exception):
    """The broker cannot be reached, refuses the connection, or the connection is lost.

    The message gives the reason.
    """


class LoginError(BrokerConnectionError):
    """The broker rejects the user name and the password, or requires them."""


class ReceivedMessage(NamedTuple):
    """Received message."""

    topic: str
    payload: bytes
    retain: bool


class PublishRejection(NamedTuple):
    """Rejection of a message by the broker."""

    reason: str
    is_retryable: bool
    """True if the message may be accepted later."""


class ConnectOptions(NamedTuple):
    """Options of each connection of a client."""

    identifier: str
    """Client identifier, equal for all connections. The broker therefore closes an older connection and publishes its
    will before it accepts a new one."""
    will: Message | None
    """Last will; None for a client that only reads."""
    on_message_lost: Callable[[str, str], None]
    """Callback with kind (``too_long``, ``overflow``) and topic of each discarded message."""
    max_waiting: int = MAX_WAITING
    """Maximum number of received messages that wait to be read; further messages are lost."""
    max_bytes: int = MAX_BYTES
    """Maximum size of a received message [bytes]. An MQTT 5 broker withholds longer messages. Longer messages of an
    older broker are discarded on arrival."""


class Connection(Protocol):
    """Open connection to a broker. Every method raises BrokerConnectionError if it is lost."""

    protocol: str
    """Name of the MQTT version."""

    async def subscribe(self, requests: str | None, others: Sequence[str]) -> dict[str, str]:
        """Subscribe at QoS 0.

        Args:
            requests: Topic filter subscribed with retain-as-published (MQTT 5), so that retained messages can be
                recognized; None: no request topics.
            others: Further topics.

        Returns:
            Rejected topics with the broker's reasons.
        """

    async def publish(self, message: Message) -> PublishRejection | None:
        """Send a message and wait until the broker has acknowledged it.

        Messages of several tasks are sent in the order of their calls.

        Returns:
            The broker's rejection, if it reports one.
        """

    async def receive(self) -> ReceivedMessage:
        """Wait for the next message."""


PORTS = {"mqtt": 1883, "mqtts": 8883}
"""Default TCP port by URL scheme."""


class Broker(NamedTuple):
    """Address of a broker."""

    url: str
    host: str
    port: int
    tls: bool


Connect = Callable[[Broker, ConnectOptions], AbstractAsyncContextManager[Connection]]
"""Function that connects to a broker. Entering its context succeeds or raises BrokerConnectionError within a bounded
time."""


def brokers(settings: BrokerSettings) -> list[Broker]:
    """Return the brokers in the order of attempts.

    Raises:
        UserError: A URL cannot be used, or a certificate or key is configured that no connection would use.
    """
    section = settings.section
    addresses = []
    for url in settings.urls:
        try:
            addresses.append(parse_url(url))
        except ValueError as error:
            raise UserError(f"{section}.url = {without_secrets(url)}: {error}") from None
    if settings.cert_file and not any(broker.tls for broker in addresses):
        raise UserError(
            f"{section}.cert_file = {settings.cert_file}: of no use without TLS: {section}.url must be mqtts://..."
        )
    if settings.key_file and not settings.cert_file:
        raise UserError(f"{section}.key_file = {settings.key_file}: of no use without {section}.cert_file")
    return addresses


def password(settings: BrokerSettings) -> str | None:
    """Read the broker's password.

    Raises:
        TemporaryError: The file cannot be read.
    """
    if settings.password_file is None:
        return None
    section = settings.section
    try:
        return credential_path(settings.password_file).read_text(encoding="utf-8").rstrip("\r\n")
    except OSError as error:
        raise TemporaryError(
            f"{section}.password_file = {settings.password_file}: cannot be read: {error.strerror}"
        ) from None
    except UnicodeDecodeError:  # its text would show bytes of the password
        raise TemporaryError(
            f"{section}.password_file = {settings.password_file}: cannot be read: not UTF-8 text"
        ) from None


def tls_context(settings: BrokerSettings) -> ssl.SSLContext:
    """Create a TLS context from the certificate files, which may have been replaced since the last connection.

    Raises:
        TemporaryError: A file cannot be read, or is invalid, perhaps because it is being replaced.
        UserError: The key is encrypted.
    """
    section = settings.section
    try:
        context = ssl.create_default_context(cafile=settings.ca_file)
    except OSError as error:  # includes ssl.SSLError
        raise TemporaryError(f"{section}.ca_file = {settings.ca_file}: no certificates can be read: {error}") from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if settings.cert_file is not None:
        _load_client_certificate(context, settings, settings.cert_file)
    return context


def check(settings: BrokerSettings) -> list[str]:
    """Check that addresses, password and certificates can be used.

    Returns:
        A sentence for each secret that every user of this machine can read.

    Raises:
        UserError: One of them cannot be used.
    """
    password(settings)
    if any(broker.tls for broker in brokers(settings)):
        tls_context(settings)
    files = {
        "password_file": settings.password_file,
        "key_file": settings.key_file or settings.cert_file,
    }
    return [
        f"{settings.section}.{key} = {name}: every user of this machine may read it; take that away with chmod o-r"
        for key, name in files.items()
        if name is not None and credential_path(name).exists() and credential_path(name).stat().st_mode & 0o004
    ]


def parse_url(address: str) -> Broker:
    """Return the address in a URL of the form that the setting ``url`` accepts.

    Raises:
        ValueError: The host or the port is invalid.
    """
    url = urlsplit(address)
    if not url.hostname or not re.fullmatch(r"(\[.*\]|[^:]*)(:\d*)?", url.netloc):  # the error must not show a password
        raise ValueError("must be mqtt://host:port, with a number as the port")
    if url.port == 0:
        raise ValueError("the port must be 1 to 65535")
    host, port = url.hostname, url.port or PORTS[url.scheme]
    host.encode("idna")  # the resolver encodes the name this way and would fail later
    return Broker(address, host, port, tls=url.scheme == "mqtts")


def _load_client_certificate(context: ssl.SSLContext, settings: BrokerSettings, cert_file: Path) -> None:
    """Load the client certificate and its key. Without a key file, the certificate file contains the key.

    Raises:
        TemporaryError: A file cannot be read, or the key does not match the certificate.
        UserError: The key is encrypted.
    """
    key_file, section = settings.key_file or cert_file, settings.section
    # load_cert_chain does not name the file that it cannot read
    for name, path in (("cert_file", cert_file), ("key_file", key_file)):
        try:
            credential_path(path).read_bytes()
        except OSError as error:
            raise TemporaryError(f"{section}.{name} = {path}: cannot be read: {error.strerror}") from None
    try:
        # without a password callback, OpenSSL would prompt on the terminal
        context.load_cert_chain(
            credential_path(cert_file), credential_path(key_file), password=partial(_refuse_password, section)
        )
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise TemporaryError(
                f"{section}.key_file = {key_file}: is not the key of {section}.cert_file = {cert_file}"
            ) from None
        raise TemporaryError(
            f"{section}.cert_file = {cert_file}, {section}.key_file = {key_file}: must be a PEM certificate and its key: {error}"
        ) from None


def _refuse_password(section: str) -> str:
    """Reject an encrypted key, because a service cannot prompt for its password.

    Raises:
        UserError: Always.
    """
    raise UserError(
        f"{section}.key_file: is encrypted, but a service cannot ask for its password; give a key without a password"
    )
