"""Metrics of a fleet in the form of prometheus-client."""

from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from bms_estimator.fleet.metrics.definitions import NODE, TENANT, WORKER, Definition
from bms_estimator.fleet.metrics.states import NodeState, TenantState

S = TypeVar("S")


def families(node: NodeState, tenants: Mapping[str, TenantState]) -> Iterator[Metric]:
    """Yield all metrics of a node and its tenants."""
    yield from _families(NODE, (), [((), node)])
    yield from _families(TENANT, ("tenant",), [((name,), state) for name, state in tenants.items()])
    workers = [((name, each.id), each) for name, state in tenants.items() for each in state.heartbeats]
    yield from _families(WORKER, ("tenant", "worker"), workers)


def _families(
    definitions: Iterable[Definition[S]], labels: Iterable[str], states: Iterable[tuple[tuple[str, ...], S]]
) -> Iterator[Metric]:
    """Yield the metrics of some states, which are given with the values of their labels."""
    for each in definitions:
        family = CounterMetricFamily if each.name.endswith("_total") else GaugeMetricFamily
        metric = family(each.name, each.meaning, labels=[*labels, *([each.label] if each.label else [])])
        for label_values, state in states:
            value = each.read(state)
            if isinstance(value, Mapping):
                for name, number in value.items():
                    metric.add_metric([*label_values, name], number)
            elif value is not None:
                metric.add_metric(label_values, value)
        yield metric
