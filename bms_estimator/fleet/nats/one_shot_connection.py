"""Connection of a command that ends after its requests. It does not reconnect: a failure is reported at once."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import nats
import nats.errors
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import (
    FLUSH_TIMEOUT_S,
    check_credentials_file,
    error_text,
    parse_addresses,
    tls_context,
)
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.model.errors import UserError

CONNECT_TIMEOUT_S = 5
"""Timeout of a connection attempt [s]."""
RETRY_S = 0.1
"""Delay between two connection attempts [s]."""


@asynccontextmanager
async def connected(server: str, creds: Path | None = None, ca: Path | None = None) -> AsyncIterator[Client]:
    """Connect without reconnecting. A lost connection ends the command.

    Raises:
        UserError: The server does not respond or rejects the client, a file cannot be read, or a request in the context fails.
    """
    callback_errors = list[Exception]()

    async def on_error(error: Exception) -> None:
        callback_errors.append(error)

    try:
        nc = await nats.connect(
            parse_addresses(server),
            user_credentials=check_credentials_file(creds) if creds is not None else None,
            tls=tls_context(ca) if ca is not None else None,
            allow_reconnect=False,
            max_reconnect_attempts=1,  # for each address
            reconnect_time_wait=RETRY_S,
            connect_timeout=CONNECT_TIMEOUT_S,
            flush_timeout=FLUSH_TIMEOUT_S,
            error_cb=on_error,
        )
    except (nats.errors.Error, OSError, ValueError) as error:
        raise UserError(f"--server {server}: {error_text(callback_errors[-1] if callback_errors else error)}") from None
    try:
        async with nc:
            yield nc
    except (StreamError, nats.errors.Error) as error:  # a denied permission is reported separately from the response
        raise UserError(f"--server {server}: {error_text(callback_errors[-1] if callback_errors else error)}") from None
