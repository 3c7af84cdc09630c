"""The Prometheus sink: the last snapshot, for whoever fetches it. Needs prometheus-client."""

import asyncio
import threading
from collections.abc import Iterable
from typing import Self
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Snapshot
from bms_estimator.model.export_settings import PrometheusSettings
from bms_estimator.sinks.metrics import metrics


class PrometheusSink(Collector):
    """Answers on an address of its own, in a thread of its own.

    Args:
        settings: The address.
    """

    def __init__(self, settings: PrometheusSettings) -> None:
        self._settings = settings
        self._last: Snapshot | None = None
        self._serving: tuple[WSGIServer, threading.Thread] | None = None

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once."""
        self._last = snapshot

    def collect(self) -> Iterable[Metric]:
        """What there is; asked for in the server's thread."""
        return metrics(self._last) if self._last is not None else ()

    async def __aenter__(self) -> Self:
        """Listen.

        Raises:
            UserError: The address cannot be listened on.
        """
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        try:
            self._serving = await asyncio.to_thread(  # it asks for the host's name, and the DNS may take its time
                start_http_server, self._settings.port, self._settings.host, registry
            )
        except OSError as error:
            told = f"prometheus.listen = {self._settings.listen}: {error.strerror}"
            raise UserError(f"{told}; each pack needs an address of its own") from None
        return self

    async def __aexit__(self, *_: object) -> None:
        """Listen no more."""
        if self._serving is not None:
            await asyncio.to_thread(_end, *self._serving)


def _end(server: WSGIServer, thread: threading.Thread) -> None:
    server.shutdown()  # waits until the thread has seen it
    server.server_close()
    thread.join()
