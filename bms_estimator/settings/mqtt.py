"""``[mqtt]``: the broker."""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field

from bms_estimator.model.config_file import Strict

Command = Literal["set_soc", "current_zero", "acknowledge_alarm", "publish_rate"]
"""A request that changes something."""


def of_brokers(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
    """Addresses as they must be.

    Raises:
        ValueError: One is not valid, or holds a name or a password.
    """
    urls = (value,) if isinstance(value, str) else value
    if not urls:
        raise ValueError("must name a broker")
    for url in urls:
        if "@" in url:
            raise ValueError("a name goes to mqtt.username, a password to a file that mqtt.password_file names")
        if not re.fullmatch(r"mqtts?://[^/\s]+", url):
            raise ValueError("must be mqtt://host:port")
    return value


class MqttSettings(Strict):
    """MQTT broker, and the requests that it may pass on."""

    model_config = ConfigDict(hide_input_in_errors=True)

    url: Annotated[str | tuple[str, ...], AfterValidator(of_brokers)] = Field(
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
        """The addresses of all brokers."""
        return (self.url,) if isinstance(self.url, str) else self.url
