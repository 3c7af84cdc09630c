"""Watch over a node of the server and, on the node that has the keys, over the tenants."""

import asyncio
import shutil
from typing import Self

from bms_estimator.fleet.metrics.states import NodeState, TenantState
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.monitor import is_healthy, query_monitor
from bms_estimator.fleet.server.nats_config import Node
from bms_estimator.fleet.server.node_spec import NodeLocation, ServerSpec, node_config
from bms_estimator.fleet.server.tenant_streams import makes_streams
from bms_estimator.fleet.server.tenant_watch import TenantWatch
from bms_estimator.process.runtime import end_tasks


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
