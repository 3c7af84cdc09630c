"""A nats-server as a child process: start it, wait for it, make its streams, forward signals.

It ends with this process, even if that is killed. It is not restarted here: systemd does that.
"""

import asyncio
import contextlib
import functools
import signal
import ssl
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import aiohttp
import nats
import structlog
from nats.aio.client import Client
from nats.errors import Error as NatsError

from bms_estimator.fleet.nats.connection import LET_IN_S, part
from bms_estimator.fleet.nats.streams import NoAnswerError, make_streams
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.nats_config import Accounts, Cluster, Node, Tls, configuration
from bms_estimator.fleet.server.server_binary import find_server
from bms_estimator.model.errors import UserError
from bms_estimator.process.child_process import ends_with_us
from bms_estimator.process.private_file import write_private
from bms_estimator.process.systemd import credential
from bms_estimator.settings.fleet import FleetSettings, TenantSettings, TlsSettings, reachable

log = structlog.get_logger(__name__)

ASK_AGAIN_S = 0.1
ASK_S = 5.0
"""One request to the monitor of a server that is busy."""
RELOAD_S = 60.0
"""A server that has not taken new settings by then does not."""
PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
"""The last: let clients go to other nodes one after another, then end."""
CONFIGURATION = "nats-server.conf"


@dataclass(frozen=True)
class NodeLocation:
    """Place of a node in the cluster, and its folder.

    Attributes:
        folder: For streams and keys.
        number: Number from 1.
        nodes: Addresses of all nodes for each other, host:port; one alone has none.
    """

    folder: Path
    number: int = 1
    nodes: tuple[str, ...] = ()

    @property
    def keys(self) -> Path:
        """Folder of the keys."""
        return self.folder / "keys"


@dataclass(frozen=True)
class ServerSpec:
    """Settings of the server.

    Attributes:
        settings: Settings of the fleet.
        accounts: Accounts of the tenants; None: whoever reaches it.
    """

    settings: FleetSettings
    accounts: Accounts | None = None


def node_of(place: NodeLocation, told: ServerSpec) -> Node:
    """Return the node's configuration."""
    server, tls = told.settings.server, told.settings.tls
    own = place.nodes[place.number - 1] if place.nodes else ""
    return Node(
        name=f"n{place.number}",
        store=place.folder / "streams",
        nats=server.listen,
        mqtt=server.mqtt,
        monitor=server.monitor,
        cluster=Cluster(_listen_address(own), place.nodes) if place.nodes else None,
        tls=_tls(tls) if tls else None,
        accounts=told.accounts,
        partitions=server.partitions,
        disk_bytes=None if server.disk_gb is None else round(credentials.GB * server.disk_gb),
        sync_s=server.sync_s or None,
    )


def _tls(settings: TlsSettings) -> Tls:
    return Tls(
        credential(settings.cert_file).absolute(),
        credential(settings.key_file).absolute(),
        credential(settings.ca_file).absolute() if settings.ca_file else None,
    )


def _check(tls: Tls) -> None:
    """Report a problem that the server would report in its own words with a wrong exit code.

    Raises:
        UserError: A file cannot be read, or key and certificate are not of each other.
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


async def serve(place: NodeLocation, read: Callable[[], ServerSpec], say: Callable[[str], None]) -> int:
    """Run a node until it ends. SIGHUP reloads its settings: tenants, limits, revoked users.

    Args:
        place: Location of this node.
        read: Reads the settings; called at start and at each SIGHUP.
        say: Receives lines for people: addresses and created streams.

    Returns:
        The server's exit code; 0 after a requested end.

    Raises:
        UserError: There is no server that will do, settings cannot be, or it refuses the streams.
    """
    binary, told = find_server(), read()
    node = node_of(place, told)
    if node.tls:
        _check(node.tls)
    _write(place.folder / CONFIGURATION, configuration(node))
    async with _running(binary, place.folder / CONFIGURATION) as (process, asked_to_end):
        ended = asyncio.create_task(process.wait())
        made = asyncio.create_task(_make_ready(place, told, process.pid, say))
        reloading = asyncio.create_task(_reload_on_signal(place, read, process, made, say))
        try:
            await asyncio.wait((ended, made), return_when=asyncio.FIRST_COMPLETED)
            if made.done() and not ended.done():
                made.result()
            code = await ended
        finally:
            made.cancel()
            reloading.cancel()
            await asyncio.gather(made, reloading, return_exceptions=True)
        return 0 if asked_to_end.is_set() else code


async def _reload_on_signal(
    place: NodeLocation,
    read: Callable[[], ServerSpec],
    process: asyncio.subprocess.Process,
    made: asyncio.Task[None],
    say: Callable[[str], None],
) -> None:
    """Reload the server's configuration at SIGHUP. Invalid settings are logged and change nothing."""
    asked = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, asked.set)
    await made
    while True:
        await asked.wait()
        asked.clear()
        try:
            told = read()
            node = node_of(place, told)
            async with asyncio.timeout(RELOAD_S):
                loaded = await _wait(node, "varz", bool)
                _write(place.folder / CONFIGURATION, configuration(node))
                process.send_signal(signal.SIGHUP)
                await _wait(node, "varz", functools.partial(_has_reloaded, loaded))
            await _make_all_streams(place, told, say)
        except (UserError, NatsError) as error:
            log.error("the settings stay as they were", reason=str(error))  # noqa: TRY400 - a person can mend it
        except TimeoutError:
            log.error("the server has not taken its new settings; what it says of them stands above")  # noqa: TRY400
        except ProcessLookupError:
            return


@contextlib.asynccontextmanager
async def _running(binary: Path, file: Path) -> AsyncIterator[tuple[asyncio.subprocess.Process, asyncio.Event]]:
    """Run the server as a child that ends with this process. Yield it and a flag that a signal sets."""
    for left in file.parent.glob("*.ports"):  # of one that was killed
        left.unlink()
    process = await asyncio.create_subprocess_exec(
        binary, "-c", file, "--ports_file_dir", file.parent, preexec_fn=ends_with_us()
    )
    asked, loop = asyncio.Event(), asyncio.get_running_loop()

    def pass_on(number: signal.Signals) -> None:
        asked.set()
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)

    for number in PASSED_ON:
        loop.add_signal_handler(number, pass_on, number)
    try:
        yield process, asked
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()
        for number in (*PASSED_ON, signal.SIGHUP):
            loop.remove_signal_handler(number)


async def _make_ready(place: NodeLocation, told: ServerSpec, pid: int, say: Callable[[str], None]) -> None:
    """Wait for the server, print its addresses, wait for a quorum, and create the streams of all tenants.

    Another server may answer on the port: this one writes a file with its number once it listens on its ports.
    """
    node = node_of(place, told)
    while not list(place.folder.glob(f"*_{pid}.ports")):  # noqa: ASYNC110 - it has no other way to tell
        await asyncio.sleep(ASK_AGAIN_S)
    secure = "s" if node.tls else ""
    say(f"edges: mqtt{secure}://{node.mqtt}  workers: {_scheme(node)}://{node.nats}  monitor: http://{node.monitor}")
    if node.cluster:
        say(f"waiting for the other nodes: {', '.join(node.cluster.routes)}")
    await _wait(node, "healthz", _has_streams)
    while True:
        try:
            return await _make_all_streams(place, told, say)
        except NoAnswerError as error:  # of a node that is busy with reconnecting clients, or without a quorum
            log.warning("the streams are not there yet; trying again", reason=str(error))


async def _make_all_streams(place: NodeLocation, told: ServerSpec, say: Callable[[str], None]) -> None:
    """Make the streams of all tenants from one of several nodes: the one with the keys, else the first."""
    node = node_of(place, told)
    if place.number != 1 if node.accounts is None else not credentials.has_keys(place.keys):
        say("ready; streams are made by the node that has the keys, the first")
        return
    for name, tenant in (told.settings.tenants or {"": TenantSettings()}).items():
        await _make_streams(place, told, name, tenant)
        where = f"; its keys: {place.keys / name}" if name else ""
        say(f"{f'tenant {name}: ' if name else ''}streams ready, {node.partitions} partitions{where}")


async def _make_streams(place: NodeLocation, told: ServerSpec, name: str, tenant: TenantSettings) -> None:
    node, server = node_of(place, told), told.settings.server
    try:
        nc = await connect(node, credentials.credentials_file(place.keys, name, Role.ADMIN) if name else None)
    except TimeoutError:
        raise NoAnswerError(f"{node.nats}: the server does not let us in in time") from None
    except (NatsError, OSError) as error:
        raise UserError(f"{node.nats}: the server lets us not in: {error}") from None
    try:
        await make_streams(
            nc,
            partitions=node.partitions,
            replicas=min(len(place.nodes), 3) or 1,
            raw_bytes=round(credentials.GB * (tenant.raw_gb or server.raw_gb)),
            raw_age_s=86_400.0 * (tenant.raw_days or server.raw_days),
        )
    except NoAnswerError:
        raise
    except UserError as error:
        hint = "; less raw_gb, or more disk, for this tenant or all?" if "insufficient" in str(error) else ""
        raise UserError(f"{f'tenant {name}: ' if name else ''}{error}{hint}") from None
    finally:
        await part(nc)


async def connect(node: Node, credentials_file: Path | None) -> Client:
    """Connect to the server on this machine.

    Raises:
        NatsError: It refuses.
    """
    host, port = reachable(node.nats)
    where = f"{_scheme(node)}://{f'[{host}]' if ':' in host else host}:{port}"
    more = {"tls": _own_certificate(node.tls)} if node.tls else {}
    users = {"user_credentials": credentials_file} if credentials_file else {}
    return await nats.connect(where, allow_reconnect=False, connect_timeout=LET_IN_S, **more, **users)


def _own_certificate(tls: Tls) -> ssl.SSLContext:
    """Trusts the certificate of this machine's server under any name."""
    context = ssl.create_default_context(cafile=str(tls.cert))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


def _has_streams(health: Mapping[str, object]) -> bool:
    return health.get("status") == "ok"


def _has_reloaded(before: Mapping[str, object], varz: Mapping[str, object]) -> bool:
    return varz.get("config_load_time") not in (None, before.get("config_load_time"))


async def _wait(node: Node, what: str, is_so: Callable[[Mapping[str, object]], bool]) -> Mapping[str, object]:
    """Poll the server's monitor until a condition holds; return its response."""
    while not is_so(said := await _ask(node, what)):  # noqa: ASYNC110 - it has no other way to tell
        await asyncio.sleep(ASK_AGAIN_S)
    return said


async def _ask(node: Node, what: str) -> Mapping[str, object]:
    """Return the response of the server's monitor; empty without a response."""
    host, port = reachable(node.monitor)
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}/{what}"
    with contextlib.suppress(aiohttp.ClientError, TimeoutError, ValueError):
        async with aiohttp.request("GET", url, timeout=aiohttp.ClientTimeout(total=ASK_S)) as answer:
            found = await answer.json()
            return found if isinstance(found, dict) else {}
    return {}


def _scheme(node: Node) -> str:
    return "tls" if node.tls else "nats"


def _listen_address(own: str) -> str:
    """Return the address on which a node listens for others; ``own`` may resolve to any of its addresses."""
    listen = reachable(own)
    return own if listen.loopback else f"0.0.0.0:{listen.port}"


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_private(path, text.encode())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error
