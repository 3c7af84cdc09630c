"""Supervisor of a nats-server as a child process: start, creation of streams, reload of settings, forwarding of signals.

The child ends with this process, even if this process is killed. After a failure, systemd restarts both. Each connection of an
edge is an open file, therefore a low limit of open files is logged.
"""

import asyncio
import contextlib
import functools
import resource
import shutil
import signal
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import replace
from pathlib import Path

import structlog
from nats.errors import Error as NatsError

from bms_estimator.fleet.nats.connection import close
from bms_estimator.fleet.nats.streams import NoAnswerError, make_streams
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.credentials import write_file
from bms_estimator.fleet.server.disk_space import available_bytes, sizes_of
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.local_client import connect, scheme
from bms_estimator.fleet.server.nats_config import Node, configuration
from bms_estimator.fleet.server.node_spec import (
    NodeLocation,
    ServerSpec,
    check_node_disk,
    check_tls_files,
    makes_streams,
    node_config,
)
from bms_estimator.fleet.server.node_watch import (
    POLL_S,
    NodeWatch,
    is_healthy,
    metrics_endpoint,
    query_monitor,
    wait_for_monitor,
)
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.child_process import find_server, terminate_with_parent
from bms_estimator.process.runtime import end_tasks
from bms_estimator.settings.fleet import FleetSettings, TenantSettings

OTHER_FILES = 1000
"""Number of open files besides the connections of edges: files of the streams and connections of workers."""
RELOAD_TIMEOUT_S = 60.0
"""Timeout of a reload of the server's settings [s]."""
FORWARDED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
"""Signals that are forwarded to the server. SIGUSR2 starts its lame duck mode, in which it disconnects its clients
gradually, so that they move to other nodes, and then ends."""
HEALTH_S = 10.0
"""Poll interval for the health of the streams [s]."""
MIN_FREE_FRACTION = 0.05
"""Minimum free fraction of a disk that was full, for the restart of the server. The alert ``FleetDiskFull`` has the same limit."""
CONFIGURATION = "nats-server.conf"
"""Name of the server's configuration file."""

log = structlog.get_logger(__name__)


async def serve(location: NodeLocation, read_spec: Callable[[], ServerSpec], report: Callable[[str], None]) -> int:
    """Run a node until it ends. SIGHUP reloads its settings: tenants, limits, revoked users.

    After its disk was full, nats-server stores nothing until it is restarted. It is restarted as soon as space is free.

    Args:
        location: Location of this node.
        read_spec: Returns the settings; called at start and at each SIGHUP.
        report: Receives progress lines: addresses and created streams.

    Returns:
        The server's exit code; 0 after a requested end.

    Raises:
        UserError: The server is missing or too old, settings are invalid, the disk is too small, or the server rejects the streams.
    """
    while (code := await _serve_until_restart(location, read_spec, report)) is None:
        log.warning("restarting nats-server, because the disk that was full has free space")
    return code


async def _serve_until_restart(
    location: NodeLocation, read_spec: Callable[[], ServerSpec], report: Callable[[str], None]
) -> int | None:
    """Run a nats-server. Arguments, result and errors are those of ``serve``; the result None requires a restart."""
    binary, spec = find_server(), read_spec()
    location = replace(location, available_bytes=available_bytes(location.streams))
    check_node_disk(location, spec)
    warn_of_open_file_limit(spec.settings)
    node = node_config(location, spec)
    if node.tls:
        check_tls_files(node.tls)
    write_file(location.folder / CONFIGURATION, configuration(node).encode())
    async with (
        NodeWatch(location) as watch,
        metrics_endpoint(spec.settings.server.metrics, node, watch),
        _running(binary, location.folder / CONFIGURATION) as (process, end_requested),
    ):
        ended = asyncio.create_task(process.wait())
        streams_ready = asyncio.create_task(_make_ready(location, spec, process.pid, report))
        supervising = asyncio.create_task(_supervise(location, spec, read_spec, process, streams_ready, report, watch))
        needs_restart = asyncio.create_task(_until_disk_has_space_again(location, node))
        try:
            await asyncio.wait((ended, streams_ready), return_when=asyncio.FIRST_COMPLETED)
            if streams_ready.done() and not ended.done():
                streams_ready.result()
            await asyncio.wait((ended, needs_restart), return_when=asyncio.FIRST_COMPLETED)
            if not ended.done():
                process.terminate()
            code = await ended
            is_restart = needs_restart.done() and not end_requested.is_set()
        finally:
            await end_tasks(streams_ready, supervising, needs_restart)
        if is_restart:
            return None
        return 0 if end_requested.is_set() else code


async def _until_disk_has_space_again(location: NodeLocation, node: Node) -> None:
    """Wait until the server has reported a full disk, and the disk has free space."""
    last_error = ""
    while True:
        await asyncio.sleep(HEALTH_S)
        error = str((await query_monitor(node, "healthz")).get("error", ""))
        if "no space" not in error:
            continue
        if error != last_error:
            log.error("the disk is full: nothing is stored until space is free", reason=error)
        last_error, disk = error, shutil.disk_usage(location.folder)
        if disk.free > MIN_FREE_FRACTION * disk.total:
            return


async def _supervise(
    location: NodeLocation,
    spec: ServerSpec,
    read_spec: Callable[[], ServerSpec],
    process: asyncio.subprocess.Process,
    streams_ready: asyncio.Task[None],
    report: Callable[[str], None],
    watch: NodeWatch,
) -> None:
    """Watch the tenants, and reload the server's configuration at SIGHUP. Invalid settings are logged and change nothing."""
    requested = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, requested.set)
    await streams_ready
    await watch.follow(spec)
    while True:
        await requested.wait()
        requested.clear()
        try:
            spec = read_spec()
            check_node_disk(location, spec)
            node = node_config(location, spec)
            async with asyncio.timeout(RELOAD_TIMEOUT_S):
                varz_before = await wait_for_monitor(node, "varz", bool)
                write_file(location.folder / CONFIGURATION, configuration(node).encode())
                process.send_signal(signal.SIGHUP)
                await wait_for_monitor(node, "varz", functools.partial(_has_reloaded, varz_before))
            await make_all_streams(location, spec, report)
            await watch.follow(spec)
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
        binary, "-c", file, "--ports_file_dir", file.parent, preexec_fn=terminate_with_parent()
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


async def _make_ready(location: NodeLocation, spec: ServerSpec, pid: int, report: Callable[[str], None]) -> None:
    """Wait for the server, report its addresses, wait for a quorum, and create the streams of all tenants.

    A response on the port could come from another server. Therefore the function waits for the file that this server
    writes as soon as it listens.
    """
    node = node_config(location, spec)
    while not list(location.folder.glob(f"*_{pid}.ports")):  # noqa: ASYNC110 - the server has no other signal
        await asyncio.sleep(POLL_S)
    secure = "s" if node.tls else ""
    report(f"edges: mqtt{secure}://{node.mqtt}  workers: {scheme(node)}://{node.nats}  monitor: http://{node.monitor}")
    if node.cluster:
        report(f"waiting for the other nodes: {', '.join(node.cluster.routes)}")
    await wait_for_monitor(node, "healthz", is_healthy)
    while True:
        try:
            return await make_all_streams(location, spec, report)
        except NoAnswerError as error:  # the node is busy with reconnecting clients, or the cluster has no quorum
            log.warning("the streams cannot be created yet; trying again", reason=str(error))


def _has_reloaded(before: Mapping[str, object], varz: Mapping[str, object]) -> bool:
    return varz.get("config_load_time") not in (None, before.get("config_load_time"))


async def make_all_streams(location: NodeLocation, spec: ServerSpec, report: Callable[[str], None]) -> None:
    """Create the streams of all tenants, if ``makes_streams`` is true for this node."""
    node = node_config(location, spec)
    if not makes_streams(location, node):
        report("ready; streams are made by the node that has the keys, the first")
        return
    for name, tenant in spec.settings.tenants_or_default.items():
        await _make_streams(location, spec, name, tenant)
        keys = f"; its keys: {location.keys / name}" if name else ""
        report(f"{f'tenant {name}: ' if name else ''}streams ready, {node.partitions} partitions{keys}")


async def _make_streams(location: NodeLocation, spec: ServerSpec, name: str, tenant: TenantSettings) -> None:
    node, server, sizes = node_config(location, spec), spec.settings.server, sizes_of(spec.settings, tenant)
    try:
        nc = await connect(node, credentials.credentials_file(location.keys, name, Role.ADMIN) if name else None)
    except TimeoutError:
        raise NoAnswerError(f"{node.nats}: the server does not accept the connection in time") from None
    except (NatsError, OSError) as error:
        raise TemporaryError(f"{node.nats}: the server rejects the connection: {error}") from None
    try:
        await make_streams(
            nc,
            partitions=node.partitions,
            replicas=location.replicas,
            raw_bytes=sizes.raw,
            raw_age_s=86_400.0 * (tenant.outage_days or server.outage_days),
            states_bytes=sizes.states,
            history_bytes=sizes.history,
            max_pack_blocks=sizes.pack_blocks,
        )
    except NoAnswerError:
        raise
    except UserError as error:
        hint = (
            ": reduce packs or outage_days, or increase disk_gb, of this tenant or of the server"
            if "insufficient" in str(error)
            else ""
        )
        raise type(error)(f"{f'tenant {name}: ' if name else ''}{error}{hint}") from None
    finally:
        await close(nc)


def warn_of_open_file_limit(settings: FleetSettings) -> None:
    """Log a warning if the limit of open files is too small for a connection of each pack's edge.

    The hard limit counts, because nats-server raises its soft limit to it.
    """
    packs = sum(tenant.packs or settings.server.packs for tenant in settings.tenants_or_default.values())
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if limit != resource.RLIM_INFINITY and limit < packs + OTHER_FILES:
        log.warning(
            "the limit of open files is too small for all edges: increase LimitNOFILE of the systemd unit, or ulimit -n",
            packs=packs,
            limit=limit,
        )
