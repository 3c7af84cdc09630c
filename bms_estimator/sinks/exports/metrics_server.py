"""HTTP server of Prometheus metrics, in the event loop. Needs prometheus-client."""

import contextlib
from collections.abc import Awaitable, Callable, Iterable
from typing import Self

from aiohttp import web
from prometheus_client.core import Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from bms_estimator.process.listener import CONNECTIONS, Listener

SHUTDOWN_TIMEOUT_S = 1.0
"""Shutdown timeout of open connections [s]."""


class _Scrape(Collector):
    """Metrics of one scrape."""

    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterable[Metric]:
        return self._metrics


class MetricsServer:
    """Server on one address while the context lasts. An address that is in use or does not exist yet is retried.

    Args:
        host, port: Listening address.
        collect: Returns the metrics; called at each scrape.
    """

    def __init__(self, host: str, port: int, collect: Callable[[], Awaitable[Iterable[Metric]]]) -> None:
        self._host, self._port, self._collect = host, port, collect
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Start listening."""
        server = web.Server(self._answer)
        listener = Listener(server)
        await listener.open_or_retry(self._host, self._port, "metrics")
        self._stack.push_async_callback(server.shutdown, SHUTDOWN_TIMEOUT_S)
        self._stack.push_async_callback(listener.close)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop listening and close all connections."""
        await self._stack.aclose()

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer a scrape on any path, in the format of its Accept header."""
        # the connection has no deadline while its request is handled
        with CONNECTIONS.serving(request.transport):
            if request.method not in {"GET", "HEAD"}:
                return web.Response(status=405, headers={"Allow": "GET, HEAD"})
            encode, content_type = choose_encoder(request.headers.get("Accept", ""))
            body = encode(_Scrape(await self._collect()))
            return web.Response(body=body, headers={"Content-Type": content_type})
