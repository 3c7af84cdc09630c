"""``[mqtt]``: brokers, credentials and allowed commands."""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field

from bms_estimator.model.config_file import Strict

Command = Literal["set_soc", "current_zero", "acknowledge_alarm", "publish_rate"]
"""Name of a request that changes the estimator or the service."""


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
            raise ValueError("set a user name as mqtt.username, and a password in the file mqtt.password_file")
        if not re.fullmatch(r"mqtts?://[^/\s]+", url):
            raise ValueError("must be mqtt://host:port")
    return value


class MqttSettings(Strict):
    """MQTT broker, and the commands that clients may send."""

    model_config = ConfigDict(hide_input_in_errors=True)

    url: Annotated[str | tuple[str, ...], AfterValidator(validate_broker_urls)] = Field(
        default="mqtt://localhost:1883",
        description="mqtt://host:port, or mqtts://host:port for TLS; or a list to try in turn",
    )
    username: str | None = None
    password_file: Path | None = Field(
        default=None,
        description="file with the password; a name without folder: a systemd credential",
    )
    ca_file: Path | None = Field(default=None, description="certificate authority for mqtts; default: the system's")
    cert_file: Path | None = Field(
        default=None, description="client certificate for mqtts, PEM, if the broker requires one; as password_file"
    )
    key_file: Path | None = Field(
        default=None, description="key of cert_file, PEM, not encrypted; default: in cert_file; as password_file"
    )
    base_topic: Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")] = Field(
        default="bms", description="first level of all topics: no +, # or spaces, no / at either end"
    )
    commands: tuple[Command, ...] = Field(
        default=(), description="requests with an effect that clients may send; default: none"
    )

    @property
    def urls(self) -> tuple[str, ...]:
        """URLs of all brokers, in the order of attempts."""
        return (self.url,) if isinstance(self.url, str) else self.url
