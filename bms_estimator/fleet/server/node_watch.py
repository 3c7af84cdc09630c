"""Watch over a node of the server, by its HTTP monitor, and, on the node that has the keys, over the tenants; metrics of both."""

import asyncio
import contextlib
import shutil
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Self

import aiohttp

from bms_estimator.fleet.metrics.states import NodeState, TenantState
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.nats_config import Node
from bms_estimator.fleet.server.node_spec import NodeLocation, ServerSpec, makes_streams, node_config
from bms_estimator.fleet.server.tenant_watch import TenantWatch
from bms_estimator.process.runtime import end_tasks
from bms_estimator.settings.connections import parse_listen
from bms_estimator.settings.fleet import client_address

if TYPE_CHECKING:
    from prometheus_client.core import Metric


POLL_S = 0.1
"""Poll interval for a state of the server [s]."""
MONITOR_TIMEOUT_S = 5.0
"""Timeout of a request to the server's monitor [s]."""


async def wait_for_monitor(
    node: Node, path: str, condition: Callable[[Mapping[str, object]], bool]
) -> Mapping[str, object]:
    """Poll the server's monitor until a condition holds; return its response."""
    while not condition(response := await query_monitor(node, path)):  # noqa: ASYNC110 - the monitor has no notifications
        await asyncio.sleep(POLL_S)
    return response


async def query_monitor(node: Node, path: str) -> Mapping[str, object]:
    """Return the response of the server's monitor; empty without a response."""
    host, port = client_address(node.monitor)
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}/{path}"
    with contextlib.suppress(aiohttp.ClientError, TimeoutError, ValueError):
        async with aiohttp.request("GET", url, timeout=aiohttp.ClientTimeout(total=MONITOR_TIMEOUT_S)) as response:
            decoded = await response.json()
            return decoded if isinstance(decoded, dict) else {}
    return {}


def is_healthy(health: Mapping[str, object]) -> bool:
    """Return True if a response to ``healthz`` reports that the server and its streams are available."""
    return health.get("status") == "ok"


class NodeWatch:
    """Watch that lasts as long as the context.

    Args:
        location: Location of the node.
    """

    def __init__(self, location: NodeLocation) -> None:
        self._location = location
        self._tenants: dict[str, TenantWatch] = {}
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await end_tasks(*self._tasks)

    async def follow(self, spec: ServerSpec) -> None:
        """Watch the tenants of these settings instead of the former ones."""
        await end_tasks(*self._tasks)
        node, keys = node_config(self._location, spec), self._location.keys
        names = spec.settings.tenants_or_default if makes_streams(self._location, node) else ()
        self._tenants = {
            name: TenantWatch(name, node, credentials.credentials_file(keys, name, Role.READER) if name else None)
            for name in names
        }
        self._tasks = [asyncio.create_task(each.run(), name="tenant watch") for each in self._tenants.values()]

    async def node_state(self, node: Node) -> NodeState:
        """Return the present state of the node."""
        health, varz = await asyncio.gather(query_monitor(node, "healthz"), query_monitor(node, "varz"))
        disk = shutil.disk_usage(self._location.folder)
        return NodeState(is_healthy(health), varz, disk.total, disk.free)

    async def tenant_states(self) -> dict[str, TenantState]:
        """Return the present states of the tenants by name."""
        states = await asyncio.gather(*(each.state() for each in self._tenants.values()))
        return dict(zip(self._tenants, states, strict=True))


@contextlib.asynccontextmanager
async def metrics_endpoint(listen: str | None, node: Node, watch: NodeWatch) -> AsyncIterator[None]:
    """Serve the metrics while the context lasts.

    Args:
        listen: Address, host:port; None: no metrics.
        node: Settings of the node.
        watch: Source of the values.
    """
    if listen is None:
        yield
        return
    from bms_estimator.fleet.metrics.families import families  # noqa: PLC0415 - loading takes time
    from bms_estimator.sinks.exports.prometheus import MetricsServer  # noqa: PLC0415

    async def collect() -> "Iterable[Metric]":
        return families(*await asyncio.gather(watch.node_state(node), watch.tenant_states()))

    async with MetricsServer(*parse_listen(listen), collect):
        yield
