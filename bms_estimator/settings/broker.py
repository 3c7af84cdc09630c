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
        raise ValueError("must name at least one broker")
    for url in urls:
        if "@" in url:
            raise ValueError("must not contain a user name or password; set username and password_file instead")
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
        description="URL of the broker, mqtt://host:port or, with TLS, mqtts://host:port; or a list of URLs to try in turn",
    )
    username: str | None = Field(default=None, description="user name at the broker")
    password_file: Path | None = Field(
        default=None,
        description="file with the password; a name without a folder is a systemd credential",
    )
    ca_file: Path | None = Field(
        default=None, description="certificate authority of an mqtts broker; default: the system's certificates"
    )
    cert_file: Path | None = Field(
        default=None,
        description="PEM file with the client certificate, if an mqtts broker requires one; a name without a folder is a systemd credential",
    )
    key_file: Path | None = Field(
        default=None,
        description="PEM file with the unencrypted key of the client certificate; default: the key is in cert_file; a name without a folder is a systemd credential",
    )

    @property
    def urls(self) -> tuple[str, ...]:
        """URLs of all brokers, in the order of attempts."""
        return (self.url,) if isinstance(self.url, str) else self.url
