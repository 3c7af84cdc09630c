"""Supervisor of a nats-server as a child process: start, creation of streams, reload of settings, forwarding of signals.

The child ends with this process, even if this process is killed. After a failure, systemd restarts both.
"""

import asyncio
import contextlib
import functools
import signal
import ssl
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import aiohttp
import nats
import structlog
from nats.aio.client import Client
from nats.errors import Error as NatsError

from bms_estimator.fleet.nats.connection import AUTH_TIMEOUT_S, close
from bms_estimator.fleet.nats.streams import NoAnswerError, make_streams
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_share, unsaved_warning
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.disk_space import GB, USABLE_FRACTION, available_bytes, check_disk_space, sizes_of
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.nats_config import Accounts, Cluster, Node, Tls, configuration
from bms_estimator.fleet.server.server_binary import find_server
from bms_estimator.model.errors import UserError
from bms_estimator.process.child_process import ends_with_us
from bms_estimator.process.private_file import write_private
from bms_estimator.process.systemd import credential
from bms_estimator.settings.fleet import FleetSettings, TenantSettings, TlsSettings, client_address

log = structlog.get_logger(__name__)

UNSAVED_S = 60.0
"""Interval between two checks how much of the streams is unsaved [s]."""
POLL_S = 0.1
"""Poll interval for a state of the server [s]."""
MONITOR_TIMEOUT_S = 5.0
"""Timeout of a request to the server's monitor [s]."""
RELOAD_TIMEOUT_S = 60.0
"""Timeout of a reload of the server's settings [s]."""
FORWARDED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
"""Signals that are forwarded to the server. SIGUSR2 starts its lame duck mode, in which it disconnects its clients
gradually, so that they move to other nodes, and then ends."""
MAX_REPLICAS = 3
"""Maximum number of replicas of a stream: with three, one node may fail."""
CONFIGURATION = "nats-server.conf"
"""Name of the server's configuration file."""


@dataclass(frozen=True)
class NodeLocation:
    """Place of a node in the cluster, and its folder.

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


def node_of(place: NodeLocation, spec: ServerSpec) -> Node:
    """Return the node's configuration."""
    server, tls = spec.settings.server, spec.settings.tls
    own_address = place.nodes[place.number - 1] if place.nodes else ""
    return Node(
        name=f"n{place.number}",
        store=place.streams,
        nats=server.listen,
        mqtt=server.mqtt,
        monitor=server.monitor,
        cluster=Cluster(_listen_address(own_address), place.nodes) if place.nodes else None,
        tls=_tls(tls) if tls else None,
        accounts=spec.accounts,
        partitions=server.partitions,
        disk_bytes=_disk_bytes(place, server.disk_gb),
        sync_s=server.sync_s or None,
    )


def _disk_bytes(place: NodeLocation, disk_gb: float | None) -> int | None:
    """Return the limit of the size of all streams [bytes]; None before the start, unless it is configured."""
    if disk_gb is not None:
        return round(GB * disk_gb)
    return None if place.available_bytes is None else round(USABLE_FRACTION * place.available_bytes)


def _tls(settings: TlsSettings) -> Tls:
    return Tls(
        credential(settings.cert_file).absolute(),
        credential(settings.key_file).absolute(),
        credential(settings.ca_file).absolute() if settings.ca_file else None,
    )


def _check_tls_files(tls: Tls) -> None:
    """Check the TLS files before the server does, because its error has the wrong exit code.

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


def _check_disk_space(place: NodeLocation, spec: ServerSpec) -> None:
    """Check that the streams of all tenants fit (``disk_space.check_disk_space``).

    Raises:
        UserError: They do not fit.
    """
    copies_per_node = place.replicas / (len(place.nodes) or 1)
    check_disk_space(spec.settings, place.streams, place.available_bytes or 0, copies_per_node)


async def serve(place: NodeLocation, read: Callable[[], ServerSpec], report: Callable[[str], None]) -> int:
    """Run a node until it ends. SIGHUP reloads its settings: tenants, limits, revoked users.

    Args:
        place: Location of this node.
        read: Reads the settings; called at start and at each SIGHUP.
        report: Receives progress lines: addresses and created streams.

    Returns:
        The server's exit code; 0 after a requested end.

    Raises:
        UserError: The server is missing or too old, settings are invalid, the disk is too small, or the server rejects the streams.
    """
    binary, spec = find_server(), read()
    place = replace(place, available_bytes=available_bytes(place.streams))
    _check_disk_space(place, spec)
    node = node_of(place, spec)
    if node.tls:
        _check_tls_files(node.tls)
    _write(place.folder / CONFIGURATION, configuration(node))
    async with _running(binary, place.folder / CONFIGURATION) as (process, end_requested):
        ended = asyncio.create_task(process.wait())
        streams_ready = asyncio.create_task(_make_ready(place, spec, process.pid, report))
        reloading = asyncio.create_task(_supervise(place, spec, read, process, streams_ready, report))
        try:
            await asyncio.wait((ended, streams_ready), return_when=asyncio.FIRST_COMPLETED)
            if streams_ready.done() and not ended.done():
                streams_ready.result()
            code = await ended
        finally:
            streams_ready.cancel()
            reloading.cancel()
            await asyncio.gather(streams_ready, reloading, return_exceptions=True)
        return 0 if end_requested.is_set() else code


async def _supervise(
    place: NodeLocation,
    spec: ServerSpec,
    read: Callable[[], ServerSpec],
    process: asyncio.subprocess.Process,
    streams_ready: asyncio.Task[None],
    report: Callable[[str], None],
) -> None:
    """Reload the server's configuration at SIGHUP, and warn of unsaved blocks. Invalid settings are logged and change nothing."""
    requested = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, requested.set)
    await streams_ready
    while True:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(UNSAVED_S):
                await requested.wait()
        if not requested.is_set():
            await _warn_of_unsaved_blocks(place, spec)
            continue
        requested.clear()
        try:
            spec = read()
            _check_disk_space(place, spec)
            node = node_of(place, spec)
            async with asyncio.timeout(RELOAD_TIMEOUT_S):
                varz_before = await _wait_for_monitor(node, "varz", bool)
                _write(place.folder / CONFIGURATION, configuration(node))
                process.send_signal(signal.SIGHUP)
                await _wait_for_monitor(node, "varz", functools.partial(_has_reloaded, varz_before))
            await _make_all_streams(place, spec, report)
        except (UserError, NatsError) as error:
            log.error("the settings were not changed", reason=str(error))  # noqa: TRY400 - a user error needs no traceback
        except TimeoutError:
            log.error("the server has not reloaded its settings; the reason is in its log lines above")  # noqa: TRY400
        except ProcessLookupError:
            return


@contextlib.asynccontextmanager
async def _running(binary: Path, file: Path) -> AsyncIterator[tuple[asyncio.subprocess.Process, asyncio.Event]]:
    """Run the server as a child that ends with this process. Yield the child, and an event that a forwarded signal sets."""
    for old_file in file.parent.glob("*.ports"):  # left by a killed server
        old_file.unlink()
    process = await asyncio.create_subprocess_exec(
        binary, "-c", file, "--ports_file_dir", file.parent, preexec_fn=ends_with_us()
    )
    end_requested, loop = asyncio.Event(), asyncio.get_running_loop()

    def forward(number: signal.Signals) -> None:
        end_requested.set()
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)

    for number in FORWARDED_SIGNALS:
        loop.add_signal_handler(number, forward, number)
    try:
        yield process, end_requested
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()
        for number in (*FORWARDED_SIGNALS, signal.SIGHUP):
            loop.remove_signal_handler(number)


async def _make_ready(place: NodeLocation, spec: ServerSpec, pid: int, report: Callable[[str], None]) -> None:
    """Wait for the server, report its addresses, wait for a quorum, and create the streams of all tenants.

    A response on the port could come from another server. Therefore the function waits for the file that this server
    writes as soon as it listens.
    """
    node = node_of(place, spec)
    while not list(place.folder.glob(f"*_{pid}.ports")):  # noqa: ASYNC110 - the server has no other signal
        await asyncio.sleep(POLL_S)
    secure = "s" if node.tls else ""
    report(f"edges: mqtt{secure}://{node.mqtt}  workers: {_scheme(node)}://{node.nats}  monitor: http://{node.monitor}")
    if node.cluster:
        report(f"waiting for the other nodes: {', '.join(node.cluster.routes)}")
    await _wait_for_monitor(node, "healthz", _is_healthy)
    while True:
        try:
            return await _make_all_streams(place, spec, report)
        except NoAnswerError as error:  # the node is busy with reconnecting clients, or the cluster has no quorum
            log.warning("the streams cannot be created yet; trying again", reason=str(error))


async def _make_all_streams(place: NodeLocation, spec: ServerSpec, report: Callable[[str], None]) -> None:
    """Create the streams of all tenants, on the node that does this."""
    node = node_of(place, spec)
    if not _makes_streams(place, node):
        report("ready; streams are made by the node that has the keys, the first")
        return
    for name, tenant in (spec.settings.tenants or {"": TenantSettings()}).items():
        await _make_streams(place, spec, name, tenant)
        keys = f"; its keys: {place.keys / name}" if name else ""
        report(f"{f'tenant {name}: ' if name else ''}streams ready, {node.partitions} partitions{keys}")


def _makes_streams(place: NodeLocation, node: Node) -> bool:
    """Return True if this node creates the streams: the node with the keys; without accounts, the first node."""
    return place.number == 1 if node.accounts is None else credentials.has_keys(place.keys)


async def _make_streams(place: NodeLocation, spec: ServerSpec, name: str, tenant: TenantSettings) -> None:
    node, server, sizes = node_of(place, spec), spec.settings.server, sizes_of(spec.settings, tenant)
    try:
        nc = await connect(node, credentials.credentials_file(place.keys, name, Role.ADMIN) if name else None)
    except TimeoutError:
        raise NoAnswerError(f"{node.nats}: the server does not accept the connection in time") from None
    except (NatsError, OSError) as error:
        raise UserError(f"{node.nats}: the server rejects the connection: {error}") from None
    try:
        await make_streams(
            nc,
            partitions=node.partitions,
            replicas=place.replicas,
            raw_bytes=sizes.raw,
            raw_age_s=86_400.0 * (tenant.outage_days or server.outage_days),
            states_bytes=sizes.states,
        )
    except NoAnswerError:
        raise
    except UserError as error:
        hint = (
            ": reduce packs or outage_days, or increase disk_gb, of this tenant or of the server"
            if "insufficient" in str(error)
            else ""
        )
        raise UserError(f"{f'tenant {name}: ' if name else ''}{error}{hint}") from None
    finally:
        await close(nc)


async def _warn_of_unsaved_blocks(place: NodeLocation, spec: ServerSpec) -> None:
    """Log a warning for each tenant whose stream is more than half full of blocks that no checkpoint includes."""
    node = node_of(place, spec)
    if not _makes_streams(place, node):
        return
    for name in spec.settings.tenants or ("",):
        try:
            nc = await connect(node, credentials.credentials_file(place.keys, name, Role.ADMIN) if name else None)
            try:
                share = await unsaved_share(nc, range(node.partitions))
            finally:
                await close(nc)
        except (NatsError, OSError) as error:
            log.warning("the stream cannot be checked", tenant=name, reason=str(error))
            continue
        if warning := unsaved_warning(share):
            log.warning("the stream fills with blocks that no checkpoint includes", tenant=name, reason=warning)


async def connect(node: Node, credentials_file: Path | None) -> Client:
    """Connect to the server on this machine.

    Raises:
        NatsError: The server rejects the connection.
    """
    host, port = client_address(node.nats)
    url = f"{_scheme(node)}://{f'[{host}]' if ':' in host else host}:{port}"
    tls = {"tls": _own_certificate(node.tls)} if node.tls else {}
    users = {"user_credentials": credentials_file} if credentials_file else {}
    return await nats.connect(url, allow_reconnect=False, connect_timeout=AUTH_TIMEOUT_S, **tls, **users)


def _own_certificate(tls: Tls) -> ssl.SSLContext:
    """Return a TLS context that trusts the certificate of this machine's server under any name."""
    context = ssl.create_default_context(cafile=str(tls.cert))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


def _is_healthy(health: Mapping[str, object]) -> bool:
    return health.get("status") == "ok"


def _has_reloaded(before: Mapping[str, object], varz: Mapping[str, object]) -> bool:
    return varz.get("config_load_time") not in (None, before.get("config_load_time"))


async def _wait_for_monitor(
    node: Node, path: str, condition: Callable[[Mapping[str, object]], bool]
) -> Mapping[str, object]:
    """Poll the server's monitor until a condition holds; return its response."""
    while not condition(response := await _query_monitor(node, path)):  # noqa: ASYNC110 - the monitor has no notifications
        await asyncio.sleep(POLL_S)
    return response


async def _query_monitor(node: Node, path: str) -> Mapping[str, object]:
    """Return the response of the server's monitor; empty without a response."""
    host, port = client_address(node.monitor)
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}/{path}"
    with contextlib.suppress(aiohttp.ClientError, TimeoutError, ValueError):
        async with aiohttp.request("GET", url, timeout=aiohttp.ClientTimeout(total=MONITOR_TIMEOUT_S)) as response:
            decoded = await response.json()
            return decoded if isinstance(decoded, dict) else {}
    return {}


def _scheme(node: Node) -> str:
    return "tls" if node.tls else "nats"


def _listen_address(cluster_address: str) -> str:
    """Return the address on which a node listens for the other nodes.

    A loopback address is used unchanged. For any other address the node listens on all interfaces, because a host name
    may resolve to any of them.
    """
    listen = client_address(cluster_address)
    return cluster_address if listen.loopback else f"0.0.0.0:{listen.port}"


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_private(path, text.encode())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error
