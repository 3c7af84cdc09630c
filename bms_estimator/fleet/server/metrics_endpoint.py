"""Address at which Prometheus reads the metrics of a node and its tenants."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable
from typing import TYPE_CHECKING

from bms_estimator.fleet.server.nats_config import Node
from bms_estimator.fleet.server.node_watch import NodeWatch
from bms_estimator.settings.outputs import parse_listen

if TYPE_CHECKING:
    from prometheus_client.core import Metric


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
