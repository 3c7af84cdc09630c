"""Connection for one request to the server: a failure is reported at once."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import nats
import nats.errors
from nats.aio.client import Client

from bms_estimator.fleet.nats.connection import FLUSH_S, addresses, context, error_text, readable
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.model.errors import UserError

CONNECT_S, RETRY_S = 5, 0.1
"""Timeout of a connection attempt, and delay between two attempts [s]."""


@asynccontextmanager
async def connected(server: str, creds: Path | None = None, ca: Path | None = None) -> AsyncIterator[Client]:
    """Connect without reconnecting: a lost connection ends the command.

    Raises:
        UserError: No response or a refusal; an unreadable file; later, an unreadable stream.
    """
    troubles = list[Exception]()

    async def trouble(error: Exception) -> None:
        troubles.append(error)

    try:
        nc = await nats.connect(
            addresses(server),
            user_credentials=readable(creds) if creds is not None else None,
            tls=context(ca) if ca is not None else None,
            allow_reconnect=False,
            max_reconnect_attempts=1,  # of each server that cannot be reached
            reconnect_time_wait=RETRY_S,
            connect_timeout=CONNECT_S,
            flush_timeout=FLUSH_S,
            error_cb=trouble,
        )
    except (nats.errors.Error, OSError, ValueError) as error:
        raise UserError(f"--server {server}: {error_text(troubles[-1] if troubles else error)}") from None
    try:
        async with nc:
            yield nc
    except (StreamError, nats.errors.Error) as error:  # a denied permission is reported separately from the response
        raise UserError(f"--server {server}: {error_text(troubles[-1] if troubles else error)}") from None
