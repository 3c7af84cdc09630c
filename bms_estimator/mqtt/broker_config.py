"""Addresses, passwords and certificates of the brokers."""

import re
import ssl
from functools import partial
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from bms_estimator.model.config_file import without_secrets
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.systemd import credential_path
from bms_estimator.settings.broker import BrokerSettings

PORTS = {"mqtt": 1883, "mqtts": 8883}
"""Default TCP port by URL scheme."""


class Broker(NamedTuple):
    """Address of a broker."""

    url: str
    host: str
    port: int
    tls: bool


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
