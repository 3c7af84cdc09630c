"""NATS connection to the server on this machine."""

import ssl
from collections.abc import Awaitable, Callable
from pathlib import Path

import nats
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import AUTH_TIMEOUT_S
from bms_estimator.fleet.server.nats_config import Node, Tls
from bms_estimator.settings.fleet import client_address


async def connect(
    node: Node, credentials_file: Path | None, on_close: Callable[[], Awaitable[None]] | None = None
) -> Client:
    """Return a new connection, which does not reconnect.

    Args:
        node: The server.
        credentials_file: Credentials of the tenant; None: without credentials.
        on_close: Called when the connection has ended.

    Raises:
        NatsError: The server rejects the connection.
    """
    host, port = client_address(node.nats)
    url = f"{scheme(node)}://{f'[{host}]' if ':' in host else host}:{port}"
    tls = {"tls": _local_tls_context(node.tls)} if node.tls else {}
    credentials = {"user_credentials": credentials_file} if credentials_file else {}
    return await nats.connect(
        url,
        allow_reconnect=False,
        connect_timeout=AUTH_TIMEOUT_S,
        closed_cb=on_close,
        error_cb=_ignore,
        **tls,
        **credentials,
    )


async def _ignore(_: Exception) -> None:
    """Ignore an error, because the request that fails raises it, or the connection ends."""


def _local_tls_context(tls: Tls) -> ssl.SSLContext:
    """Return a TLS context that trusts the certificate of this machine's server under any name."""
    context = ssl.create_default_context(cafile=str(tls.cert))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


def scheme(node: Node) -> str:
    """Return the scheme of the server's address for NATS clients."""
    return "tls" if node.tls else "nats"
