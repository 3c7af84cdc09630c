"""``bms-estimator fleet serve``, ``fleet user`` and ``fleet users``: server node, and tokens for edges."""

import asyncio
import os
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import TypeAdapter, ValidationError

from bms_estimator.cli.options.table import count_text
from bms_estimator.fleet.packs.csv_table import read_table
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.nats_config import CLUSTER_PORT, Accounts
from bms_estimator.fleet.server.nats_server import serve as run_node
from bms_estimator.fleet.server.node_spec import NodeLocation, ServerSpec
from bms_estimator.model.config_file import error_reason, read_toml
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import configure_logs, flush_logs
from bms_estimator.settings.connections import parse_listen
from bms_estimator.settings.fleet import FleetSettings
from bms_estimator.settings.pack import DeviceName

SettingsFile = Annotated[
    Path | None,
    typer.Argument(
        help="settings file of the fleet, fleet.toml; without a file, the default settings apply", show_default=False
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="folder for streams and keys; default: server.folder of the settings, otherwise the user's state folder"
    ),
]


def serve(
    settings_file: SettingsFile = None,
    folder: Folder = None,
    listen: Annotated[
        str | None, typer.Option(help="host:port for workers; default: server.listen of the settings")
    ] = None,
    mqtt: Annotated[str | None, typer.Option(help="host:port for edges; default: server.mqtt of the settings")] = None,
    metrics: Annotated[
        str | None,
        typer.Option(help="host:port of the metrics for Prometheus; default: server.metrics of the settings"),
    ] = None,
    node: Annotated[int, typer.Option(min=1, max=5, help="position of this node in the list of --cluster, from 1")] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(
            help="addresses under which the 3 or 5 nodes of a cluster connect to each other: host,host:port,...; "
            f"default port: {CLUSTER_PORT}"
        ),
    ] = None,
) -> None:
    """Run a node of the fleet server, which stores samples and results in streams, until SIGINT or SIGTERM.

    The first start writes the keys of each tenant to --folder.
    In a cluster, copy keys/claims.json from the folder of node 1 to the folder of each other node.
    """
    settings = _settings(settings_file, listen=listen, mqtt=mqtt, metrics=metrics)
    location = NodeLocation(_folder(settings, folder), node, _nodes(settings, node, cluster))

    def read_spec() -> ServerSpec:
        settings = _settings(settings_file, listen=listen, mqtt=mqtt, metrics=metrics)
        return ServerSpec(settings, _accounts(settings, location))

    configure_logs()
    with flush_logs():
        exit_code = asyncio.run(run_node(location, read_spec, typer.echo))
    raise typer.Exit(exit_code)


TenantName = Annotated[str, typer.Argument(help="name of the tenant, as in the settings", show_default=False)]
SettingsOption = Annotated[
    Path | None,
    typer.Option(
        "--settings", help="settings file of the fleet, fleet.toml; without a file, the default settings apply"
    ),
]
ValidDays = Annotated[
    float | None,
    typer.Option(min=0.0, max=36_600.0, help="number of days for which a token is valid; default: unlimited"),
]


def user(
    tenant: TenantName,
    pack: Annotated[str, typer.Argument(help="name of the pack", show_default=False)],
    settings_file: SettingsOption = None,
    folder: Folder = None,
    days: ValidDays = None,
) -> None:
    """Print the token of a pack's edge, which the edge uses as its MQTT password.

    With the token an edge can only send samples of this pack and receive the replies. Keep the token secret.
    """
    try:
        TypeAdapter(DeviceName).validate_python(pack)
    except ValidationError:
        raise UserError(f"{pack!r}: not a pack name: at most 64 letters, digits, _ and -") from None
    typer.echo(_edge_tokens(tenant, [pack], settings_file, folder, days)[pack])


def users(
    tenant: TenantName,
    table: Annotated[Path, typer.Argument(help="table of packs, as for `fleet packs load`", show_default=False)],
    out: Annotated[
        Path, typer.Option(help="folder for files PACK.token, or a CSV file NAME.csv; only you can read the files")
    ],
    settings_file: SettingsOption = None,
    folder: Folder = None,
    days: ValidDays = None,
) -> None:
    """Write the tokens of the edges of all packs in a table. `fleet user` prints a single token."""
    packs = read_table(table).packs
    credentials.write_tokens(out, _edge_tokens(tenant, packs, settings_file, folder, days))
    typer.echo(f"{out}: {count_text(len(packs), 'token')} written; keep them secret")


def _edge_tokens(
    tenant: str, packs: Iterable[str], settings_file: Path | None, folder: Path | None, days: float | None
) -> dict[str, str]:
    keys, now = NodeLocation(_folder(_settings(settings_file), folder)).keys, datetime.now(UTC)
    return credentials.edge_tokens(keys, tenant, packs, now, None if days is None else now + timedelta(days=days))


def _settings(path: Path | None, **options: str | None) -> FleetSettings:
    """Return the settings with the options of the command line.

    Raises:
        UserError: An option is invalid.
    """
    settings = read_toml(path, FleetSettings) if path else FleetSettings()
    given = {name: value for name, value in options.items() if value is not None}
    if not given:
        return settings
    table: dict[str, Any] = settings.model_dump()
    try:
        return FleetSettings.model_validate(table | {"server": table["server"] | given})
    except ValidationError as error:
        reason = error_reason(error.errors()[0])
        options_text = ", ".join(f"--{name} {value}" for name, value in given.items())
        raise UserError(f"{options_text}: {reason}") from None


def _folder(settings: FleetSettings, option: Path | None) -> Path:
    """Return the folder of streams and keys, from the first source that has one: --folder, settings, systemd, user."""
    systemd_folder = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    user_folder = Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "bms-estimator-fleet"
    return (option or settings.server.folder or Path(systemd_folder or user_folder)).expanduser().absolute()


def _nodes(settings: FleetSettings, number: int, cluster: str | None) -> tuple[str, ...]:
    """Return the addresses under which the nodes of a cluster connect to each other; empty for a single node.

    Args:
        settings: Settings of the fleet.
        number: Position of this node in the list, from 1.
        cluster: List of host or host:port, separated by commas; None: a single node.

    Raises:
        UserError: --cluster is invalid, or keys and certificates are missing.
    """
    if cluster is None:
        if number != 1:
            raise UserError(f"--node {number}: requires --cluster host,host,host, which names all nodes")
        return ()
    nodes = tuple(host if _has_port(host) else f"{host}:{CLUSTER_PORT}" for host in cluster.split(","))
    if len(set(nodes)) != len(nodes) or len(nodes) not in (3, 5):
        raise UserError(
            f"--cluster {cluster}: must name 3 or 5 distinct nodes, so that a majority remains if one fails"
        )
    if number > len(nodes):
        raise UserError(f"--node {number}: --cluster names only {len(nodes)} nodes")
    try:
        if not all(parse_listen(node).loopback for node in nodes):
            settings.reject_unprotected(f"--cluster {cluster}")
    except ValueError as error:
        raise UserError(f"--cluster {cluster}: {error}") from None
    return nodes


def _has_port(host: str) -> bool:
    """Return True if a host ends in a port. An IPv6 address contains colons, and needs brackets to have a port."""
    return host.rpartition(":")[2].isdigit() and (host.count(":") == 1 or "]:" in host)


def _accounts(settings: FleetSettings, location: NodeLocation) -> Accounts | None:
    """Return the accounts of the tenants; None without tenants.

    The first node, and each node to which the operator's key was copied, creates the keys of the tenants. Other nodes
    read the claims that the first node has written.

    Raises:
        UserError: The keys or the claims cannot be read, or the claims were not copied to this node.
    """
    if not settings.tenants:
        return None
    if location.number == 1 or credentials.has_keys(location.keys):
        return credentials.make_accounts(location.keys, settings.tenants, datetime.now(UTC))
    return credentials.read_accounts(location.keys)
