"""The text of a nats-server's configuration: one node, or one of a cluster. Pure: the caller writes the file.

What the keys mean: the server's own documentation, https://docs.nats.io/running-a-nats-service/configuration.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.connection import LET_IN_S

NATS_PORT, MQTT_PORT, MONITOR_PORT, CLUSTER_PORT = 4222, 1883, 8222, 6222
"""Default ports of NATS; the monitor has no authentication and stays on the loopback."""
MAX_BLOCK_BYTES = 1 << 20
"""Maximum size of a message [bytes]: a block of 60 samples takes 700 bytes, one of a whole day at 1 Hz less than
this."""
MAX_CONNECTIONS = 200_000
"""Maximum number of connections of a node: if two of three are down, one has all edges. The server's default is
65,536."""


@dataclass(frozen=True)
class Cluster:
    """Cluster settings of a node.

    Attributes:
        listen: Address of this node for the others, host:port.
        routes: Addresses of all nodes for each other, host:port, including this one.
    """

    listen: str
    routes: tuple[str, ...]


@dataclass(frozen=True)
class Tls:
    """Files in PEM.

    Attributes:
        cert: The server's certificate, and what leads from it to the authority.
        key: Private key.
        ca: Authority that the nodes trust; None: as clients do, by those of the system.
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
        claims: Public key of each account -> its claims.
    """

    operator: str
    system: str
    claims: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Node:
    """One server.

    Attributes:
        name: Name in the cluster.
        store: Folder of the streams.
        nats: Address for workers, host:port; likewise ``mqtt`` for edges, and ``monitor``.
        cluster: The other nodes; None: it is alone.
        tls: For all ports but the monitor's; None: none.
        accounts: Accounts of the tenants; None: whoever reaches it, as one tenant.
        partitions: Number of partitions of the stream ``RAW``.
        disk_bytes: The most that streams take; None: the server's default, three quarters of the free space.
        memory_bytes: As above.
        sync_s: Interval between two fsyncs [s]; None: each message before it is acknowledged.
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
    patience = f"authorization {{ timeout: {LET_IN_S} }}"
    lines = [
        f"server_name: {_text(node.name)}",
        f"listen: {_text(node.nats)}",
        f"http: {_text(node.monitor)}",
        f"max_payload: {MAX_BLOCK_BYTES}",
        f"max_connections: {MAX_CONNECTIONS}",
        *([tls] if tls else []),
        patience,
        f"jetstream {{ {_jetstream(node)} }}",
        f"mqtt {{ listen: {_text(node.mqtt)}, {patience}{f', {tls}' if tls else ''} }}",
        *_cluster(node),
        *_accounts(node),
    ]
    return "\n".join(lines) + "\n"


def _jetstream(node: Node) -> str:
    limits = {"max_file_store": node.disk_bytes, "max_memory_store": node.memory_bytes}
    told = [f"{name}: {value}" for name, value in limits.items() if value is not None]
    sync = "always" if node.sync_s is None else f'"{round(1000 * node.sync_s)}ms"'
    return ", ".join([f"store_dir: {_text(str(node.store))}", *told, f"sync_interval: {sync}"])


def _cluster(node: Node) -> list[str]:
    if node.cluster is None:
        return []
    routes = ", ".join(_text(f"nats://{route}") for route in node.cluster.routes)
    tls = f", {_tls(node.tls, mutual=True)}" if node.tls else ""
    return [f"cluster {{ name: fleet, listen: {_text(node.cluster.listen)}, routes: [{routes}]{tls} }}"]


def _accounts(node: Node) -> list[str]:
    """Return the lines with accounts and permissions; without accounts, any client may connect."""
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
    """Nodes show each other a certificate; clients show a token in place of one."""
    files = {"cert_file": tls.cert, "key_file": tls.key} | ({"ca_file": tls.ca} if tls.ca else {})
    told = ", ".join(f"{name}: {_text(str(path))}" for name, path in files.items())
    return f"tls {{ {told}, timeout: {LET_IN_S}{', verify: true' if mutual else ''} }}"


def _text(value: str) -> str:
    """Quote a text as the server reads it, as in JSON."""
    return json.dumps(value, ensure_ascii=False)
