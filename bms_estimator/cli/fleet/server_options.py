"""Options of all fleet commands: address of the server, and credentials; and requests of a command that ends after them."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from nats.aio.client import Client

T = TypeVar("T")

DEFAULT_SERVER = "nats://127.0.0.1:4222"
"""Default address of the server."""

Server = Annotated[
    str,
    typer.Option(
        help="address of the fleet server, nats://host:port or tls://host:port; separate several nodes with commas"
    ),
]
Creds = Annotated[
    Path | None,
    typer.Option(help="credentials file of the tenant; required if the server has tenants", show_default=False),
]
Ca = Annotated[
    Path | None,
    typer.Option(
        help="file with the certificate authority of the server; default: the system's certificates", show_default=False
    ),
]
ServerAddress = tuple[str, Path | None, Path | None]
"""URLs of the server, credentials file, and certificate authority."""


def on_server(address: ServerAddress, action: "Callable[[Client], Awaitable[T]]") -> T:
    """Run an action with a connection to the server, and return its result.

    Raises:
        UserError: The server does not respond, rejects the client, or rejects a request of the action.
    """
    from bms_estimator.fleet.nats.one_shot_connection import connected  # noqa: PLC0415 - NATS is optional

    async def run() -> T:
        async with connected(*address) as nc:
            return await action(nc)

    return asyncio.run(run())
