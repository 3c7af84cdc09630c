"""Prometheus metrics of a pack: names of the payloads' fields with the base unit of Prometheus at the end.

``voltage_v`` is ``bms_voltage_volts``, ``energy_out_kwh`` is ``bms_energy_out_joules_total``. Needs prometheus-client.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from bms_estimator.model.payloads import Estimate, Health, Snapshot


class Unit(NamedTuple):
    """A unit of Prometheus."""

    name: str
    factor: float = 1.0
    """Factor from the payload's unit to this one."""


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
"""Last part of a field's name -> its unit."""
RATIOS = ("soc", "soc_std", "soc_coulomb", "soc_ocv", "delta_1", "delta_2", "stability_margin")
"""Shares of 1."""
COUNTERS = (
    "frames_received",
    "frames_lost",
    "crc_errors",
    "energy_out_kwh",
    "energy_in_kwh",
    "charge_out_ah",
    "charge_in_ah",
    "restarts",
    "reconnects",
    "lock_losses",
    "gain_rearms",
    "publish_drops",
    "broker_losses",
    "availability_corrections",
)
"""Fields that only grow."""
LEFT_OUT = ("soc_percent", "board_time_s")
"""Fields that repeat another one, or a clock with an arbitrary origin."""
KINDS = {"line": "what the line counted", "samples": "samples by what became of them", "requests": "requests by kind"}
"""Fields of the health payload that count by kind -> their help text."""
OWN_NAMES = {"cells_v": "cell"}
"""Lists -> what one of them is."""


def metrics(snapshot: Snapshot) -> Iterator[Metric]:
    """All there is of a pack; the state only while values are fresh."""
    device, health = snapshot.info.device, snapshot.health
    if snapshot.estimate is not None and health.sensor_online:
        yield from _fields(device, snapshot.estimate, Estimate)
    yield from _fields(device, health, Health)
    for name, meaning in KINDS.items():
        yield _by_kind(device, name, meaning, getattr(health, name))
    yield _elements(device, snapshot)
    yield _alarms(device, snapshot)
    yield _watched(device, snapshot)
    info = GaugeMetricFamily("bms_info", "what this is; always 1", labels=["device", "cell", "version"])
    info.add_metric([device, snapshot.info.cell, snapshot.info.version], 1.0)
    yield info


def _fields(device: str, report: Estimate | Health, model: type[Estimate | Health]) -> Iterator[Metric]:
    """Numbers and truth values of a payload."""
    for name, field in model.model_fields.items():
        value, said = getattr(report, name), field.description or name
        if name in LEFT_OUT:
            continue
        if isinstance(value, bool | int | float):
            full, factor = named(name)
            family = CounterMetricFamily if name in COUNTERS else GaugeMetricFamily
            metric = family(full, said, labels=["device"])
            metric.add_metric([device], value * factor)
            yield metric
        elif isinstance(value, list) and name in OWN_NAMES:
            yield _places(device, name, said, value)


def _places(device: str, name: str, said: str, values: Iterable[float | None]) -> Metric:
    """Yield the metrics of a list, numbered from 1."""
    full, factor = named(f"{OWN_NAMES[name]}_{name.rsplit('_', 1)[-1]}")
    metric = GaugeMetricFamily(full, said, labels=["device", OWN_NAMES[name]])
    for number, value in enumerate(values, start=1):
        if value is not None:
            metric.add_metric([device, str(number)], value * factor)
    return metric


def _by_kind(device: str, name: str, meaning: str, counts: Mapping[str, int]) -> Metric:
    metric = CounterMetricFamily(f"bms_{name}", f"{meaning}, since start", labels=["device", "kind"])
    for kind, count in counts.items():
        metric.add_metric([device, kind], count)
    return metric


def _elements(device: str, snapshot: Snapshot) -> Metric:
    """Learned parameters that may be relied on, in the unit of their names."""
    metric = GaugeMetricFamily("bms_element", "in the SI unit of its name", labels=["device", "element"])
    for name, parameter in snapshot.parameters.elements.items():
        if parameter.valid and parameter.value is not None:
            metric.add_metric([device, name], parameter.value)
    return metric


def _alarms(device: str, snapshot: Snapshot) -> Metric:
    metric = GaugeMetricFamily("bms_alarm", "1 while it is raised", labels=["device", "name", "severity"])
    for alarm in snapshot.alarms:
        metric.add_metric([device, alarm.name, alarm.severity], float(alarm.active))
    return metric


def _watched(device: str, snapshot: Snapshot) -> Metric:
    meaning = "0 while what the alarm needs is missing, so that it cannot be raised"
    metric = GaugeMetricFamily("bms_alarm_watched", meaning, labels=["device", "name", "severity"])
    for alarm in snapshot.alarms:
        metric.add_metric([device, alarm.name, alarm.severity], float(alarm.watched))
    return metric


def named(field: str) -> tuple[str, float]:
    """Return a field's metric name without ``_total``, and its scale factor."""
    if field in RATIOS:
        return f"bms_{field}_ratio", 1.0
    stem, _, last = field.rpartition("_")
    unit = UNITS.get(last)
    if unit is None or not stem:
        return f"bms_{field}", 1.0
    return f"bms_{stem}_{unit.name}", unit.factor
