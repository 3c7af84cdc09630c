"""Configuration text of a nats-server: a single node, or a node of a cluster. The caller writes the file.

The keys are documented in https://docs.nats.io/running-a-nats-service/configuration.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import AUTH_TIMEOUT_S

NATS_PORT = 4222
"""Default TCP port for workers."""
MQTT_PORT = 1883
"""Default TCP port for edges."""
MONITOR_PORT = 8222
"""Default TCP port of the monitor, which has no authentication and listens on the loopback only."""
CLUSTER_PORT = 6222
"""Default TCP port for the other nodes of a cluster."""
MAX_PAYLOAD_BYTES = 2 << 20
"""Maximum size of a message [bytes]. A block of 60 samples has 700 bytes. The longest message, the history of a
pack with its fit, has 0.9 MB."""
MAX_CONNECTIONS = 200_000
"""Maximum number of connections of a node. If two of three nodes are down, all edges connect to the third node. The
server's default is 65,536."""


@dataclass(frozen=True)
class Cluster:
    """Cluster settings of a node.

    Attributes:
        listen: Address on which this node listens for the others, host:port.
        routes: Cluster addresses of all nodes, host:port, including this one.
    """

    listen: str
    routes: tuple[str, ...]


@dataclass(frozen=True)
class Tls:
    """TLS files in PEM format.

    Attributes:
        cert: Certificate chain of the server.
        key: Private key.
        ca: Authority that the nodes trust; None: the system's authorities.
    """

    cert: Path
    key: Path
    ca: Path | None = None


@dataclass(frozen=True)
class Accounts:
    """Public signed claims of the accounts.

    Attributes:
        operator: The operator's claims.
        system: Public key of the system's account.
        claims: Claims by public key of the account.
    """

    operator: str
    system: str
    claims: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Node:
    """Settings of one server.

    Attributes:
        name: Name in the cluster.
        store: Folder of the streams.
        nats, mqtt, monitor: Addresses for workers, edges and the monitor, host:port.
        cluster: Cluster settings; None: a single node.
        tls: TLS files for all ports except the monitor's; None: without TLS.
        accounts: Accounts of the tenants; None: without authentication, as a single tenant.
        partitions: Number of partitions of the stream ``RAW``, for its creation. The configuration file does not contain it.
        disk_bytes: Maximum size of the streams [bytes]; None: the server's default, three quarters of the free space.
        memory_bytes: Maximum size of streams in memory [bytes]; None: the server's default.
        sync_s: Interval between two fsyncs [s]. A power failure loses the messages since the last one. None: each message is
            synced before it is acknowledged.
    """

    name: str
    store: Path
    nats: str = f"127.0.0.1:{NATS_PORT}"
    mqtt: str = f"127.0.0.1:{MQTT_PORT}"
    monitor: str = f"127.0.0.1:{MONITOR_PORT}"
    cluster: Cluster | None = None
    tls: Tls | None = None
    accounts: Accounts | None = None
    partitions: int = subjects.PARTITIONS
    disk_bytes: int | None = None
    memory_bytes: int | None = None
    sync_s: float | None = 10.0


def configuration(node: Node) -> str:
    """Return the server's configuration file."""
    tls = _tls(node.tls) if node.tls else ""
    authorization = f"authorization {{ timeout: {AUTH_TIMEOUT_S} }}"
    lines = [
        f"server_name: {_quoted(node.name)}",
        f"listen: {_quoted(node.nats)}",
        f"http: {_quoted(node.monitor)}",
        f"max_payload: {MAX_PAYLOAD_BYTES}",
        f"max_connections: {MAX_CONNECTIONS}",
        *([tls] if tls else []),
        authorization,
        f"jetstream {{ {_jetstream(node)} }}",
        f"mqtt {{ listen: {_quoted(node.mqtt)}, {authorization}{f', {tls}' if tls else ''} }}",
        *_cluster(node),
        *_accounts(node),
    ]
    return "\n".join(lines) + "\n"


def _jetstream(node: Node) -> str:
    limits = {"max_file_store": node.disk_bytes, "max_memory_store": node.memory_bytes}
    configured = [f"{name}: {value}" for name, value in limits.items() if value is not None]
    sync = "always" if node.sync_s is None else f'"{round(1000 * node.sync_s)}ms"'
    return ", ".join([f"store_dir: {_quoted(str(node.store))}", *configured, f"sync_interval: {sync}"])


def _cluster(node: Node) -> list[str]:
    if node.cluster is None:
        return []
    routes = ", ".join(_quoted(f"nats://{route}") for route in node.cluster.routes)
    tls = f", {_tls(node.tls, mutual=True)}" if node.tls else ""
    return [f"cluster {{ name: fleet, listen: {_quoted(node.cluster.listen)}, routes: [{routes}]{tls} }}"]


def _accounts(node: Node) -> list[str]:
    """Return the lines of the accounts; without accounts any client may connect."""
    if node.accounts is None:
        return []
    preload = [f"  {key}: {claims}" for key, claims in node.accounts.claims.items()]
    return [
        f"operator: {node.accounts.operator}",
        f"system_account: {node.accounts.system}",
        "resolver: MEMORY",
        "resolver_preload {",
        *preload,
        "}",
    ]


def _tls(tls: Tls, *, mutual: bool = False) -> str:
    """Return the TLS block. With ``mutual`` the peer must present a certificate; clients present a token instead."""
    files = {"cert_file": tls.cert, "key_file": tls.key} | ({"ca_file": tls.ca} if tls.ca else {})
    entries = ", ".join(f"{name}: {_quoted(str(path))}" for name, path in files.items())
    return f"tls {{ {entries}, timeout: {AUTH_TIMEOUT_S}{', verify: true' if mutual else ''} }}"


def _quoted(value: str) -> str:
    """Return a quoted string of the server's configuration language, which equals that of JSON."""
    return json.dumps(value, ensure_ascii=False)
