"""Prometheus sink: serves metrics of the last snapshot. Needs prometheus-client."""

import contextlib
from collections.abc import Iterable
from typing import Self

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.process.listener import CONNECTIONS, Listener
from bms_estimator.settings.exports import PrometheusSettings
from bms_estimator.sinks.exports.prometheus_metrics import metrics

CLOSING_S = 1.0
"""Shutdown timeout of open connections [s]."""


class PrometheusSink(Collector):
    """Sink that serves metrics on its own address, in the event loop.

    Args:
        settings: Listening address.
    """

    def __init__(self, settings: PrometheusSettings) -> None:
        self._settings = settings
        self._last: Snapshot | None = None
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        self._stack = contextlib.AsyncExitStack()

    def publish(self, snapshot: Snapshot) -> None:
        """Store a snapshot for the next scrape, with the last estimate if it has none."""
        estimate = snapshot.estimate or (self._last and self._last.estimate)
        self._last = snapshot._replace(estimate=estimate)

    def collect(self) -> Iterable[Metric]:
        """Return the metrics of the last snapshot."""
        return metrics(self._last) if self._last is not None else ()

    async def __aenter__(self) -> Self:
        """Start listening.

        Raises:
            UserError: The address cannot be used.
        """
        server = web.Server(self._answer)
        listener = Listener(server)
        try:
            await listener.open(self._settings.host, self._settings.port)
        except OSError as error:
            problem = f"prometheus.listen = {self._settings.listen}: {error.strerror}"
            raise UserError(f"{problem}; each pack needs an address of its own") from None
        self._stack.push_async_callback(server.shutdown, CLOSING_S)
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
            return web.Response(body=encode(self._registry), headers={"Content-Type": content_type})
