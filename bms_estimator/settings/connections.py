"""Settings of the connections of a service: brokers with their credentials, addresses to listen on, page, edge and exports."""

import ipaddress
import re
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, ConfigDict, Field, model_validator

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


Topic = Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")]
"""MQTT topic without wildcards and spaces, and without a slash at either end."""


class HomeAssistantSettings(Strict):
    """Discovery by Home Assistant over the MQTT broker; see docs/pack/home-assistant.md."""

    enabled: bool = Field(
        default=True, description="false: no discovery; the pack's device is removed from Home Assistant"
    )
    discovery_prefix: Topic = Field(
        default="homeassistant", description="discovery prefix of Home Assistant's MQTT integration"
    )
    status_topic: Topic = Field(default="homeassistant/status", description="topic of Home Assistant's birth message")
    name: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="name of the pack's device; default: pack.name"
    )
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive", description="direction of positive current and power in Home Assistant"
    )
    names: dict[str, Annotated[str, Field(min_length=1)]] = Field(
        default={},
        description='names of entities in place of the default names, such as energy_in_kwh = "Energie geladen"',
    )


Command = Literal["set_soc", "current_zero", "acknowledge_alarm", "publish_rate", "forget_pack"]
"""Name of a request that changes the estimator or the service."""


class MqttSettings(BrokerSettings):
    """MQTT broker, and the commands that clients may send."""

    base_topic: Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")] = Field(
        default="bms", description="prefix of all topics; must not contain +, # or spaces, nor begin or end with /"
    )
    profile: Literal["venus-os"] | None = Field(
        default=None,
        description="also publish the battery for a Victron GX device, in the format of dbus-mqtt-battery, on the topic venus below the topic of the pack",
    )
    commands: tuple[Command, ...] = Field(default=(), description="commands that clients may send; default: none")


DEFAULT_LISTEN = "127.0.0.1:8765"
"""Default address of the page, host:port."""


class ListenAddress(NamedTuple):
    """Address on which a server listens."""

    host: str
    port: int
    """TCP port; 0: any free port."""

    @property
    def loopback(self) -> bool:
        """True if only programs on this machine can connect."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def parse_listen(text: str) -> ListenAddress:
    """Parse ``host:port``.

    Raises:
        ValueError: The text is not a host and a port.
    """
    try:
        url = urlsplit(f"//{text}")
        host, port = url.hostname, url.port
        (host or "").encode("idna")  # the resolver encodes the name this way and would fail later
    except ValueError as error:
        raise ValueError(f"must be host:port: {error}") from None
    if not host or port is None or url.netloc != text or re.search(r"[@\s]", text):
        raise ValueError('must be host:port, such as "127.0.0.1:8765" or "[::1]:8765"')
    return ListenAddress(host, port)


def _validate_listen(text: str) -> str:
    parse_listen(text)
    return text


Address = Annotated[str, AfterValidator(_validate_listen)]
"""Text ``host:port``."""


class ListenSettings(Strict):
    """Address on which a server listens."""

    listen: Address

    @property
    def address(self) -> ListenAddress:
        """Host and port of ``listen``."""
        return parse_listen(self.listen)


class PageSettings(ListenSettings):
    """Live web page of the pack."""

    listen: Address = Field(
        default=DEFAULT_LISTEN,
        description="host:port of the page; packs of one process with the same address share a page. An address that other machines can reach, such as 0.0.0.0:8765, requires token_file",
    )
    token_file: Path | None = Field(
        default=None,
        description="file with the access token; a name without a folder is a systemd credential",
    )
    hosts: tuple[str, ...] = Field(
        default=(), description="further host names under which browsers request the page, for example behind a proxy"
    )

    @model_validator(mode="after")
    def _require_token_unless_local(self) -> Self:
        if self.token_file is None and not self.address.loopback:
            raise ValueError(
                f'listen = "{self.listen}" is open to other machines: name a token_file, or listen on 127.0.0.1'
            )
        return self


class EdgeSettings(BrokerSettings):
    """Edge of a fleet: fleet server to which raw samples are sent, and their storage; see docs/fleet/edge.md."""

    section: ClassVar[str] = "edge"

    url: BrokerUrls = Field(
        default="mqtt://localhost:1883",
        description="URL of the fleet server, mqtt://host:port or, with TLS, mqtts://host:port; or a list of URLs to try in turn",
    )
    block_s: Annotated[float, Field(ge=1.0, le=3600.0)] = Field(
        default=60.0,
        description="duration of a block of samples, which is stored and sent as one message; a killed process loses at most one block",
    )
    store_mib: Annotated[float, Field(ge=0.1, le=100_000.0)] = Field(
        default=100.0,
        description="maximum size of the stored blocks [MiB]; the default holds 100 days at 1 Hz. A full store drops its oldest block",
    )
    cells: bool = Field(
        default=False,
        description="send the voltages of the single cells too, if the source delivers them; upgrade all workers first, because "
        "earlier ones reject these blocks",
    )


Name = Annotated[str, Field(min_length=1)]


class InfluxSettings(Strict):
    """Export of estimates and alarm changes to InfluxDB, or to another server that accepts its line protocol over HTTP."""

    url: Annotated[str, Field(pattern=r"^https?://(\[[^\]\s]+\]|[^/@\s?#:]+)(:\d{1,5})?(/[^@\s?#]*)?$")] = Field(
        default="http://localhost:8086", description="http://host:port or https://host:port, without user and password"
    )
    database: Name = Field(default="bms", description="database of InfluxDB 1; ignored if bucket is set")
    username: str | None = Field(default=None, description="user name for InfluxDB 1, if required")
    password_file: Path | None = Field(
        default=None,
        description="file with the password for InfluxDB 1; a name without a folder is a systemd credential",
    )
    bucket: Name | None = Field(default=None, description="bucket of InfluxDB 2, which replaces database")
    org: Name | None = Field(default=None, description="organization of InfluxDB 2")
    token_file: Path | None = Field(
        default=None,
        description="file with a write token of InfluxDB 2; a name without a folder is a systemd credential",
    )
    ca_file: Path | None = Field(
        default=None, description="certificate authority of an https server; default: the system's certificates"
    )
    every_s: Annotated[float, Field(ge=0.1, le=3600)] = Field(
        default=10.0, description="interval between two write requests"
    )

    @model_validator(mode="after")
    def _check_credentials(self) -> Self:
        if self.bucket and (self.username or self.password_file):
            raise ValueError("username and password_file: of no use with bucket; give token_file instead")
        if not self.bucket and (self.token_file or self.org):
            raise ValueError("org and token_file: of no use without bucket")
        return self


class PrometheusSettings(ListenSettings):
    """Endpoint from which Prometheus reads metrics."""

    listen: Address = Field(
        default="127.0.0.1:9108",
        description="host:port of this pack's metrics; every client that can connect to it can read them",
    )

    @model_validator(mode="after")
    def _require_port(self) -> Self:
        if not self.address.port:
            raise ValueError("port: must be 1 to 65535")
        return self
