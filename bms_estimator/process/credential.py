"""Where a password lies: in a file, or among the credentials that systemd hands to the service while it runs."""

import os
from pathlib import Path

CREDENTIALS = Path("/run/credentials")
"""Where systemd keeps the credentials of all units."""


def credential(name: Path) -> Path:
    """The file of this name in ``$CREDENTIALS_DIRECTORY`` where there is one, else ``name`` as it stands."""
    own = Path(os.environ.get("CREDENTIALS_DIRECTORY", ""), name)
    return own if os.access(own, os.R_OK) else name


def is_for_the_service(name: Path) -> bool:
    """Whether only the running service can read it: no file here, but where or as a credential of systemd is named."""
    named = not name.is_absolute() or name.is_relative_to(CREDENTIALS)
    return named and not os.access(credential(name), os.R_OK)
