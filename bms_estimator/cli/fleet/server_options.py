"""Options of all fleet commands: address of the server, and credentials."""

from pathlib import Path
from typing import Annotated

import typer

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
