"""Prometheus sink: serves metrics of the last snapshot. Needs prometheus-client."""

from collections.abc import Iterable
from typing import Self

from prometheus_client.core import Metric

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.settings.exports import PrometheusSettings
from bms_estimator.sinks.exports.metrics_server import MetricsServer
from bms_estimator.sinks.exports.prometheus_metrics import metrics


class PrometheusSink:
    """Sink that serves metrics on its own address.

    Args:
        settings: Listening address.
    """

    def __init__(self, settings: PrometheusSettings) -> None:
        self._last: Snapshot | None = None
        self._server = MetricsServer(settings.host, settings.port, self._collect)

    def publish(self, snapshot: Snapshot) -> None:
        """Store a snapshot for the next scrape, with the last estimate if it has none."""
        estimate = snapshot.estimate or (self._last and self._last.estimate)
        self._last = snapshot._replace(estimate=estimate)

    async def __aenter__(self) -> Self:
        """Start listening."""
        await self._server.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop listening and close all connections."""
        await self._server.__aexit__()

    async def _collect(self) -> Iterable[Metric]:
        """Return the metrics of the last snapshot."""
        return metrics(self._last) if self._last is not None else ()
