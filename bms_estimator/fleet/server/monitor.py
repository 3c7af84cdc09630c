"""Requests to the HTTP monitor of a nats-server on this machine."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping

import aiohttp

from bms_estimator.fleet.server.nats_config import Node
from bms_estimator.settings.fleet import client_address

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
