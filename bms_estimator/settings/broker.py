"""Connection to an MQTT broker: addresses, credentials and certificates. Several sections share these settings."""

import re
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import AfterValidator, ConfigDict, Field

from bms_estimator.model.config_file import Strict


def validate_broker_urls(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
    """Return broker URLs after checking them.

    Raises:
        ValueError: A URL is invalid, or contains a user name or a password.
    """
    urls = (value,) if isinstance(value, str) else value
    if not urls:
        raise ValueError("must name a broker")
    for url in urls:
        if "@" in url:
            raise ValueError("set a user name as username, and a password in the file password_file")
        if not re.fullmatch(r"mqtts?://[^/\s]+", url):
            raise ValueError("must be mqtt://host:port")
    return value


BrokerUrls = Annotated[str | tuple[str, ...], AfterValidator(validate_broker_urls)]
"""URL of a broker, or several to try in turn."""


class BrokerSettings(Strict):
    """Connection to a broker.

    Attributes:
        section: Name of the settings section, for errors.
    """

    model_config = ConfigDict(hide_input_in_errors=True)
    section: ClassVar[str] = "mqtt"

    url: BrokerUrls = Field(
        default="mqtt://localhost:1883",
        description="mqtt://host:port, or mqtts://host:port for TLS; or a list to try in turn",
    )
    username: str | None = None
    password_file: Path | None = Field(
        default=None,
        description="file with the password; a name without a folder is a systemd credential",
    )
    ca_file: Path | None = Field(default=None, description="certificate authority for mqtts; default: the system's")
    cert_file: Path | None = Field(
        default=None,
        description="PEM file with the client certificate for mqtts, if the broker requires one; a name without a folder is a systemd credential",
    )
    key_file: Path | None = Field(
        default=None,
        description="PEM file with the unencrypted key of cert_file; default: cert_file; a name without a folder is a systemd credential",
    )

    @property
    def urls(self) -> tuple[str, ...]:
        """URLs of all brokers, in the order of attempts."""
        return (self.url,) if isinstance(self.url, str) else self.url
