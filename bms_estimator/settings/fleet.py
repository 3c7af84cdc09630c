"""The settings of a fleet's server: what ``fleet.toml`` holds."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, AwareDatetime, Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.pack import DeviceName
from bms_estimator.settings.page import Listen, parse_listen

Gigabytes = Annotated[float, Field(gt=0, le=1e6)]
TenantName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]


def _of_listen(text: str) -> str:
    parse_listen(text)
    return text


Address = Annotated[str, AfterValidator(_of_listen)]


class ServerSettings(Strict):
    """One node, and what its streams keep."""

    folder: Path | None = Field(
        default=None,
        description="streams and keys; systemd's StateDirectory when left out, else the user's XDG state folder",
    )
    listen: Address = Field(default="127.0.0.1:4222", description="host:port for workers, pages and questions")
    mqtt: Address = Field(default="127.0.0.1:1883", description="host:port for edges; 8883 is usual with TLS")
    monitor: Address = Field(
        default="127.0.0.1:8222", description="host:port where the server tells how it is; on the loopback"
    )
    partitions: Annotated[int, Field(ge=1, le=256)] = Field(
        default=64, description="among which workers share the packs; stays as it was when the streams were made"
    )
    raw_gb: Gigabytes = Field(
        default=8.0,
        description="what edges have sent is kept up to this size, a tenant; 100,000 packs at 1 Hz: 100 a day",
    )
    raw_days: Annotated[float, Field(gt=0, le=3660)] = Field(default=7.0, description="and so long")
    disk_gb: Gigabytes | None = Field(
        default=None, description="the most that all streams take; three quarters of what is free when left out"
    )
    sync_s: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=10.0,
        description="a power cut may lose so much of what one node alone has; 0: nothing, each message waits for the disk",
    )

    @model_validator(mode="after")
    def _monitor_asks_nobody(self) -> Self:
        if not parse_listen(self.monitor).loopback:
            raise ValueError(f'monitor = "{self.monitor}": it asks nobody for a name: listen on 127.0.0.1')
        return self


class TlsSettings(Strict):
    """Certificates of all ports but the monitor's, PEM."""

    cert_file: Path = Field(
        description="the server's certificate, with what leads to its authority; a name alone: systemd's credential"
    )
    key_file: Path = Field(description="its private key, not encrypted; as cert_file")
    ca_file: Path | None = Field(
        default=None, description="authority of the nodes' certificates, among several nodes; as cert_file"
    )


class TenantSettings(Strict):
    """A tenant with separate streams, workers and packs."""

    raw_gb: Gigabytes | None = Field(default=None, description="as server.raw_gb, which holds when left out")
    raw_days: Annotated[float, Field(gt=0, le=3660)] | None = Field(default=None, description="as server.raw_days")
    disk_gb: Gigabytes | None = Field(
        default=None, description="the most that all streams take, each copy counted; without: as much as there is"
    )
    revoked: dict[DeviceName, AwareDatetime] = Field(
        default={}, description="pack -> time: its tokens from before are refused, as after a theft"
    )


class FleetSettings(Strict):
    """A fleet's settings file."""

    server: ServerSettings = ServerSettings()
    tls: TlsSettings | None = Field(default=None, description="needed beyond this machine")
    tenants: dict[TenantName, TenantSettings] = Field(
        default={}, description="[tenants.NAME]; without any, all who reach the server are one"
    )

    @model_validator(mode="after")
    def _open_to_others(self) -> Self:
        for name in ("listen", "mqtt"):
            where = getattr(self.server, name)
            if not parse_listen(where).loopback:
                self.refuse_open(f'server.{name} = "{where}"')
        return self

    def refuse_open(self, where: str) -> None:
        """Reject a server that other machines can reach without TLS and tenants.

        Args:
            where: What lets them.

        Raises:
            ValueError: There is no TLS, or no tenant: whoever reaches it could read and write all.
        """
        missing = [text for there, text in ((self.tls, "[tls]"), (self.tenants, "[tenants.NAME]")) if not there]
        if missing:
            raise ValueError(f"{where} is open to other machines: add {' and '.join(missing)}, or listen on 127.0.0.1")


def reachable(listen: str) -> Listen:
    """Return the address at which a program on this machine reaches the listener."""
    host, port = parse_listen(listen)
    return Listen({"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host), port)  # noqa: S104 - what others listen on
