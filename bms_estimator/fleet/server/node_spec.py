"""Location and settings of a node of the server, and the configuration that follows from them."""

import ssl
from dataclasses import dataclass
from pathlib import Path

from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.disk_space import GB, USABLE_FRACTION, check_disk_space
from bms_estimator.fleet.server.nats_config import Accounts, Cluster, Node, Tls
from bms_estimator.model.errors import UserError
from bms_estimator.process.systemd import credential_path
from bms_estimator.settings.fleet import FleetSettings, TlsSettings, client_address

MAX_REPLICAS = 3
"""Maximum number of replicas of a stream: with three, one node may fail."""


@dataclass(frozen=True)
class NodeLocation:
    """Number of a node in the cluster, and its folder.

    Attributes:
        folder: Folder of streams and keys.
        number: Number of the node, from 1.
        nodes: Cluster addresses of all nodes, host:port; empty for a single node.
        available_bytes: Space that the streams could use at the start [bytes]; None before the start. It is not updated,
            because the server cannot change its limit at a reload.
    """

    folder: Path
    number: int = 1
    nodes: tuple[str, ...] = ()
    available_bytes: int | None = None

    @property
    def keys(self) -> Path:
        """Folder of the keys."""
        return self.folder / "keys"

    @property
    def streams(self) -> Path:
        """Folder of the streams."""
        return self.folder / "streams"

    @property
    def replicas(self) -> int:
        """Number of replicas of each stream."""
        return min(len(self.nodes), MAX_REPLICAS) or 1


@dataclass(frozen=True)
class ServerSpec:
    """Settings of the server.

    Attributes:
        settings: Settings of the fleet.
        accounts: Accounts of the tenants; None: without authentication.
    """

    settings: FleetSettings
    accounts: Accounts | None = None


def node_config(location: NodeLocation, spec: ServerSpec) -> Node:
    """Return the node's configuration."""
    server, tls = spec.settings.server, spec.settings.tls
    own_address = location.nodes[location.number - 1] if location.nodes else ""
    return Node(
        name=f"n{location.number}",
        store=location.streams,
        nats=server.listen,
        mqtt=server.mqtt,
        monitor=server.monitor,
        cluster=Cluster(_listen_address(own_address), location.nodes) if location.nodes else None,
        tls=_tls(tls) if tls else None,
        accounts=spec.accounts,
        partitions=server.partitions,
        disk_bytes=_disk_bytes(location, server.disk_gb),
        sync_s=server.sync_s or None,
    )


def _disk_bytes(location: NodeLocation, disk_gb: float | None) -> int | None:
    """Return the limit of the size of all streams [bytes]; None before the start, unless it is configured."""
    if disk_gb is not None:
        return round(GB * disk_gb)
    return None if location.available_bytes is None else round(USABLE_FRACTION * location.available_bytes)


def _tls(settings: TlsSettings) -> Tls:
    return Tls(
        credential_path(settings.cert_file).absolute(),
        credential_path(settings.key_file).absolute(),
        credential_path(settings.ca_file).absolute() if settings.ca_file else None,
    )


def check_tls_files(tls: Tls) -> None:
    """Check the TLS files before nats-server does, whose exit code would not report a wrong setting.

    Raises:
        UserError: A file cannot be read, or the key does not belong to the certificate.
    """
    for name, path in (("cert_file", tls.cert), ("key_file", tls.key), ("ca_file", tls.ca)):
        try:
            if path:
                path.open("rb").close()
        except OSError as error:
            raise UserError(f"tls.{name} = {path}: cannot be read: {error.strerror}") from None
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(tls.cert, tls.key)
    except ssl.SSLError as error:
        raise UserError(f"tls.cert_file = {tls.cert}, tls.key_file = {tls.key}: {error.reason or error}") from None


def check_node_disk(location: NodeLocation, spec: ServerSpec) -> None:
    """Check that the streams of all tenants fit (``disk_space.check_disk_space``).

    Raises:
        UserError: They do not fit.
    """
    copies_per_node = location.replicas / (len(location.nodes) or 1)
    check_disk_space(spec.settings, location.streams, location.available_bytes or 0, copies_per_node)


def _listen_address(cluster_address: str) -> str:
    """Return the address on which a node listens for the other nodes.

    A loopback address is used unchanged. For any other address the node listens on all interfaces, because a host name
    may resolve to any of them.
    """
    listen = client_address(cluster_address)
    return cluster_address if listen.loopback else f"0.0.0.0:{listen.port}"


def makes_streams(location: NodeLocation, node: Node) -> bool:
    """Return True if this node creates the streams: the node with the keys; without accounts, the first node."""
    return location.number == 1 if node.accounts is None else credentials.has_keys(location.keys)
