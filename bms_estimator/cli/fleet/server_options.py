"""Options that all commands of a fleet have in common: where its server is, and what opens its door."""

from pathlib import Path
from typing import Annotated

import typer

SERVER = "nats://127.0.0.1:4222"

Server = Annotated[str, typer.Option(help="of the fleet, nats://host:port or tls://host:port; several with commas")]
Creds = Annotated[
    Path | None, typer.Option(help="the tenant's credentials, where the server asks for some", show_default=False)
]
Ca = Annotated[
    Path | None,
    typer.Option(help="certificate of who signed the server's; else those of the system", show_default=False),
]
ServerAddress = tuple[str, Path | None, Path | None]
"""Server, credentials, authority."""
