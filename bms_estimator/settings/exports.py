"""``[influx]`` and ``[prometheus]``: exports besides MQTT; ``[edge]``: raw samples to a fleet's server, in blocks."""

from pathlib import Path
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.broker import BrokerSettings, BrokerUrls


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


class PrometheusSettings(Strict):
    """Endpoint from which Prometheus reads metrics."""

    listen: Annotated[str, Field(pattern=r"^([^:\s/@]+|\[[0-9A-Fa-f:]+\]):\d{1,5}$")] = Field(
        default="127.0.0.1:9108",
        description="host:port of this pack's metrics; every client that can connect to it can read them",
    )

    @property
    def host(self) -> str:
        """Host without brackets."""
        return self.listen.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """TCP port."""
        return int(self.listen.rpartition(":")[2])

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        if not 0 < self.port < 65536:
            raise ValueError("port: must be 1 to 65535")
        self.host.encode("idna")  # the resolver encodes the name this way and would fail later
        return self
