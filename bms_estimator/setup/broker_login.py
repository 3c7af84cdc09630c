"""Login at an MQTT broker: its URL with user name and password, as they are asked for in the setup."""

import functools
import os
import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self
from urllib.parse import quote, unquote

from bms_estimator.mqtt.connection import parse_url

ADDRESS_FORM = "mqtt://host:port, or with a login mqtt://user:pw@host; mqtts:// for TLS"
"""Form of an address. Characters of the user name may be percent-encoded, because : and @ are separators."""
_ADDRESS = re.compile(r"(mqtts?://)(?:([^:@/\s]*)(?::(.*))?@)?([^@/\s]+)")


@dataclass(frozen=True)
class BrokerLogin:
    """Broker, and the login that it requires."""

    url: str
    """URL without user name and password."""
    username: str | None = None
    password: str | None = field(default=None, repr=False)

    @classmethod
    def parse(cls, address: str) -> Self:
        """Return the login in an address of the form ``ADDRESS_FORM``. User name and password may be missing.

        Raises:
            ValueError: The address has another form, or its port is invalid. The message does not contain the password.
        """
        match = _ADDRESS.fullmatch(address.strip())
        if match is None:
            raise ValueError(f"must be {ADDRESS_FORM}")
        scheme, username, password, host = match.groups()
        url = f"{scheme}{host}"
        parse_url(url)
        return cls(url, unquote(username) if username else None, None if password is None else unquote(password))

    @property
    def address(self) -> str:
        """Address with user name and password, as ``parse`` reads it."""
        if self.username is None:
            return self.url
        scheme, _, host = self.url.partition("://")
        return f"{scheme}://{quote(self.username, safe='')}:{quote(self.password or '', safe='')}@{host}"

    def settings(self, password_file: Path | str) -> dict[str, object]:
        """Return the settings of the broker. With a password they contain the path ``password_file``."""
        file = None if self.password is None else str(password_file)
        values = {"url": self.url, "username": self.username, "password_file": file}
        return {key: value for key, value in values.items() if value is not None}

    @property
    def temporary_settings(self) -> dict[str, object]:
        """Settings of the broker with a file of the password that exists until the program ends."""
        path = Path(_private_folder().name, f"{abs(hash(self))}")
        self.write_password(path)
        return self.settings(path)

    def write_password(self, path: Path) -> None:
        """Write the password, if there is one, to a file that only this user can read."""
        if self.password is None:
            return
        with open(path, "w", encoding="utf-8", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(self.password)


@functools.cache
def _private_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="bms-estimator-")
