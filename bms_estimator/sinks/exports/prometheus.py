"""Prometheus sink: serves metrics of the last snapshot over HTTP, in the event loop. Needs prometheus-client.

Metrics have the names of the payloads' fields with Prometheus' base unit as suffix: ``voltage_v`` is
``bms_voltage_volts``, ``energy_out_kwh`` is ``bms_energy_out_joules_total``.
"""

import contextlib
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from typing import NamedTuple, Self

from aiohttp import web
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import Health
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.model.quantity import quantity
from bms_estimator.process.listener import CONNECTIONS, Listener
from bms_estimator.settings.connections import PrometheusSettings

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


class Unit(NamedTuple):
    """Base unit of Prometheus."""

    name: str
    factor: float = 1.0
    """Factor from the payload's unit to the base unit."""


UNITS = {
    "v": Unit("volts"),
    "a": Unit("amperes"),
    "w": Unit("watts"),
    "c": Unit("celsius"),
    "s": Unit("seconds"),
    "hz": Unit("hertz"),
    "ohm": Unit("ohms"),
    "farad": Unit("farads"),
    "mib": Unit("bytes", 1024.0**2),
    "ah": Unit("coulombs", 3600.0),
    "wh": Unit("joules", 3600.0),
    "kwh": Unit("joules", 3.6e6),
}
"""Units by the last part of a field's name."""
COUNTER_FIELDS = {"line": "counters of the link", "samples": "samples by result", "requests": "requests by result"}
"""Help texts of the fields of the health payload that count by kind."""
LIST_ITEMS = {"cells_v": "cell"}
"""Names of one item, by list field."""


def metrics(snapshot: Snapshot) -> Iterator[Metric]:
    """Yield all metrics of a pack. Metrics of the state are included only while values are fresh."""
    device, health = snapshot.info.device, snapshot.health
    if snapshot.estimate is not None and health.sensor_online:
        yield from _fields(device, snapshot.estimate, Estimate)
    yield from _fields(device, health, Health)
    for name, meaning in COUNTER_FIELDS.items():
        yield _counters_by_kind(device, name, meaning, getattr(health, name))
    yield _elements(device, snapshot)
    yield _alarms(device, snapshot)
    yield _watched(device, snapshot)
    info = GaugeMetricFamily("bms_info", "cell and version; always 1", labels=["device", "cell", "version"])
    info.add_metric([device, snapshot.info.cell, snapshot.info.version], 1.0)
    yield info


def _fields(device: str, report: Estimate | Health, model: type[Estimate | Health]) -> Iterator[Metric]:
    """Yield metrics of the numbers and Booleans of a payload."""
    for name, field in model.model_fields.items():
        value, help_text = getattr(report, name), field.description or name
        metric_kind = quantity(model, name).prometheus
        if metric_kind == "none":
            continue
        if isinstance(value, bool | int | float):
            metric_name, factor = (f"bms_{name}_ratio", 1.0) if metric_kind == "ratio" else name_and_factor(name)
            family = CounterMetricFamily if metric_kind == "counter" else GaugeMetricFamily
            metric = family(metric_name, help_text, labels=["device"])
            metric.add_metric([device], value * factor)
            yield metric
        elif isinstance(value, list) and name in LIST_ITEMS:
            yield _list_metric(device, name, help_text, value)


def _list_metric(device: str, name: str, help_text: str, values: Iterable[float | None]) -> Metric:
    """Return the metric of a list, with items numbered from 1."""
    metric_name, factor = name_and_factor(f"{LIST_ITEMS[name]}_{name.rsplit('_', 1)[-1]}")
    metric = GaugeMetricFamily(metric_name, help_text, labels=["device", LIST_ITEMS[name]])
    for number, value in enumerate(values, start=1):
        if value is not None:
            metric.add_metric([device, str(number)], value * factor)
    return metric


def _counters_by_kind(device: str, name: str, meaning: str, counts: Mapping[str, int]) -> Metric:
    metric = CounterMetricFamily(f"bms_{name}", f"{meaning}, since start", labels=["device", "kind"])
    for kind, count in counts.items():
        metric.add_metric([device, kind], count)
    return metric


def _elements(device: str, snapshot: Snapshot) -> Metric:
    """Return the metric of valid learned parameters."""
    metric = GaugeMetricFamily(
        "bms_element", "learned parameter, in the unit of its name", labels=["device", "element"]
    )
    for name, parameter in snapshot.parameters.elements.items():
        if parameter.valid and parameter.value is not None:
            metric.add_metric([device, name], parameter.value)
    return metric


def _alarms(device: str, snapshot: Snapshot) -> Metric:
    metric = GaugeMetricFamily("bms_alarm", "1 while the alarm is raised", labels=["device", "name", "severity"])
    for alarm in snapshot.alarms:
        metric.add_metric([device, alarm.name, alarm.severity], float(alarm.active))
    return metric


def _watched(device: str, snapshot: Snapshot) -> Metric:
    meaning = "0 while a quantity that the alarm needs is missing, so that it cannot be raised"
    metric = GaugeMetricFamily("bms_alarm_watched", meaning, labels=["device", "name", "severity"])
    for alarm in snapshot.alarms:
        metric.add_metric([device, alarm.name, alarm.severity], float(alarm.watched))
    return metric


def name_and_factor(field: str) -> tuple[str, float]:
    """Return a field's metric name without ``_total``, and its scale factor."""
    stem, _, last = field.rpartition("_")
    unit = UNITS.get(last)
    if unit is None or not stem:
        return f"bms_{field}", 1.0
    return f"bms_{stem}_{unit.name}", unit.factor


class PrometheusSink:
    """Sink that serves metrics on its own address.

    Args:
        settings: Listening address.
    """

    def __init__(self, settings: PrometheusSettings) -> None:
        self._last: Snapshot | None = None
        self._server = MetricsServer(*settings.address, self._collect)

    def publish(self, snapshot: Snapshot) -> None:
        """Store a snapshot for the next scrape, with the last estimate if it has none."""
        estimate = snapshot.estimate or (self._last and self._last.estimate)
        self._last = snapshot._replace(estimate=estimate)

    async def __aenter__(self) -> Self:
        await self._server.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._server.__aexit__()

    async def _collect(self) -> Iterable[Metric]:
        """Return the metrics of the last snapshot."""
        return metrics(self._last) if self._last is not None else ()
