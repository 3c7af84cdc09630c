"""Settings of a fleet's server, from ``fleet.toml``."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import AwareDatetime, Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.connections import Address, ListenAddress, parse_listen
from bms_estimator.settings.pack import DeviceName

Gigabytes = Annotated[float, Field(gt=0, le=1e6)]
PackCount = Annotated[int, Field(ge=1, le=10_000_000)]
Days = Annotated[float, Field(gt=0, le=3660)]
CellCount = Annotated[int, Field(ge=0, le=255)]
TenantName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]


class ServerSettings(Strict):
    """Server node: addresses, and limits of its streams."""

    folder: Path | None = Field(
        default=None,
        description="folder of streams and keys; default: StateDirectory of the systemd unit, otherwise bms-estimator-fleet in the user's XDG state folder",
    )
    listen: Address = Field(default="127.0.0.1:4222", description="host:port for workers, pages and queries")
    mqtt: Address = Field(default="127.0.0.1:1883", description="host:port for edges; usually port 8883 with TLS")
    monitor: Address = Field(
        default="127.0.0.1:8222",
        description="host:port of the server's monitoring, which must be on the loopback interface",
    )
    metrics: Address | None = Field(
        default=None,
        description="host:port at which Prometheus reads metrics of server, streams and workers; every client that can connect to it can read them; default: no metrics",
    )
    partitions: Annotated[int, Field(ge=1, le=256)] = Field(
        default=64,
        description="number of partitions of packs, which the workers divide among themselves; cannot be changed after the streams were created",
    )
    packs: PackCount = Field(
        default=1000, description="number of packs of each tenant, from which the sizes of the streams are computed"
    )
    outage_days: Days = Field(
        default=7.0,
        description="time without workers after which the server still has all blocks [days]; older blocks are dropped",
    )
    cells: CellCount = Field(
        default=0,
        description="number of single cells of a pack whose voltages its edge sends, from which the sizes of the streams are computed",
    )
    block_s: Annotated[float, Field(ge=1, le=3600)] = Field(
        default=60.0,
        description="shortest block_s of the edges [s], which determines the number of blocks of each pack that the server stores",
    )
    disk_gb: Gigabytes | None = Field(
        default=None, description="maximum size of all streams; default: three quarters of the free space at the start"
    )
    sync_s: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=10.0,
        description="interval between fsyncs; a power failure loses messages since the last fsync, unless another node has them; 0: fsync after each message",
    )

    @model_validator(mode="after")
    def _check_that_monitor_is_local(self) -> Self:
        if not parse_listen(self.monitor).loopback:
            raise ValueError(f'monitor = "{self.monitor}": the monitor has no access control; listen on 127.0.0.1')
        return self


class TlsSettings(Strict):
    """Certificates for all ports but the monitor's, PEM."""

    cert_file: Path = Field(
        description="server certificate with its intermediate certificates; a name without a folder is a systemd credential"
    )
    key_file: Path = Field(
        description="unencrypted private key of cert_file; a name without a folder is a systemd credential"
    )
    ca_file: Path | None = Field(
        default=None,
        description="authority of the nodes' certificates in a cluster; a name without a folder is a systemd credential",
    )


class TenantSettings(Strict):
    """A tenant with separate streams, workers and packs."""

    packs: PackCount | None = Field(default=None, description="number of packs; default: server.packs")
    outage_days: Days | None = Field(
        default=None, description="time without workers that must be bridged [days]; default: server.outage_days"
    )
    cells: CellCount | None = Field(
        default=None, description="number of single cells whose voltages are sent; default: server.cells"
    )
    disk_gb: Gigabytes | None = Field(
        default=None, description="maximum size of all streams of the tenant, including replicas; default: no limit"
    )
    revoked: dict[DeviceName, AwareDatetime] = Field(
        default={},
        description="revocation times by pack; tokens of a pack that were issued before its time are rejected, for example after a theft",
    )


class FleetSettings(Strict):
    """A fleet's settings file."""

    server: ServerSettings = ServerSettings()
    tls: TlsSettings | None = Field(default=None, description="required if clients on other machines connect")
    tenants: dict[TenantName, TenantSettings] = Field(
        default={},
        description="a section [tenants.NAME] for each tenant; default: one tenant for all clients of the server",
    )

    @property
    def tenants_or_default(self) -> dict[str, TenantSettings]:
        """Settings by name of the tenant; without tenants, default settings under an empty name."""
        return self.tenants or {"": TenantSettings()}

    @model_validator(mode="after")
    def _check_protection(self) -> Self:
        for name in ("listen", "mqtt"):
            address = getattr(self.server, name)
            if not parse_listen(address).loopback:
                self.reject_unprotected(f'server.{name} = "{address}"')
        return self

    def reject_unprotected(self, setting: str) -> None:
        """Reject a server that other machines can reach without TLS and tenants.

        Args:
            setting: Setting or option that makes the server reachable from other machines, for the error.

        Raises:
            ValueError: TLS or tenants are missing, so that any client could read and write all data.
        """
        missing = [name for section, name in ((self.tls, "[tls]"), (self.tenants, "[tenants.NAME]")) if not section]
        if missing:
            raise ValueError(
                f"{setting} is open to other machines: add {' and '.join(missing)}, or listen on 127.0.0.1"
            )


def client_address(listen: str) -> ListenAddress:
    """Return the address at which clients on this machine connect to the listener."""
    host, port = parse_listen(listen)
    return ListenAddress({"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host), port)  # noqa: S104 - the server's address
