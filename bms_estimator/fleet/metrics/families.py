"""Metrics of a fleet for prometheus-client: names, descriptions, and values from the state of the fleet.

A metric whose name ends in ``_total`` is a counter.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Generic, NamedTuple, TypeVar

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.metrics.states import NodeState, StreamState, TenantState

S = TypeVar("S")
Value = float | Mapping[str, float] | None
"""Value of a metric, or its values by the metric's own label; None: the metric has no sample."""
MIB = 1 << 20
"""Mebibyte [bytes]."""
MQTT_SESSIONS_STREAM = "$MQTT_sess"
"""Stream of nats-server with one message for each MQTT session, also of a disconnected client."""

EVENTS = {
    "resends": "blocks that were already processed, because the edge sent them again",
    "gaps": "blocks that arrived before an earlier one",
    "lost_blocks": "blocks that no longer arrive",
    "former_store": "blocks of a store that the edge has replaced",
    "damaged": "messages that cannot be decoded",
    "deferred": "messages that wait for the table of packs or for the pack's share of the CPU",
    "not_deferred": "messages of unknown packs that were skipped, because too many wait",
    "misplaced": "rejected blocks that are in the wrong partition",
    "too_dense": "rejected blocks with too many samples",
    "failed": "blocks skipped because of an internal error",
    "lethal": "blocks skipped because workers died in them",
    "repeated": "messages that the stream delivered again",
    "fits": "adopted fits of packs",
    "late_fits": "fits without a result at the time of their adoption",
    "failed_fits": "fits whose adoption failed",
    "stale_fits": "results of fits that the pack no longer awaits",
    "dropped_samples": "samples that the estimator rejected",
    "time_steps_back": "samples whose time decreased",
    "no_time": "samples with an implausible time",
    "no_arrival": "blocks with an implausible arrival time",
    "clock_ahead": "blocks whose edge's clock is ahead",
    "clock_behind": "blocks whose edge's clock is behind",
    "table_changes": "changed rows of the table of packs",
    "taken_over": "packs whose state was adapted to other settings or another version",
    "not_taken_over": "packs whose estimator began again, because its state did not fit",
    "begun_anew": "packs whose state was dropped, because their settings changed",
    "damaged_states": "states that could not be restored",
}
"""Meaning of the events that ``bms_fleet_worker_events_total`` counts."""


class Definition(NamedTuple, Generic[S]):
    """Metric of a state of type ``S``."""

    name: str
    meaning: str
    read: Callable[[S], Value]
    label: str = ""
    """Label of the values, if there are several."""


def _each_stream(read: Callable[[StreamState], int | None]) -> Callable[[TenantState], Value]:
    """Return a function that calls ``read`` for each stream."""

    def values(state: TenantState) -> Mapping[str, float]:
        numbers = {name: read(stream) for name, stream in (state.streams or {}).items()}
        return {name: number for name, number in numbers.items() if number is not None}

    return values


def _mqtt_sessions(state: TenantState) -> Value:
    if state.streams is None:
        return None
    sessions = state.streams.get(MQTT_SESSIONS_STREAM)
    return sessions.messages if sessions else 0.0


NODE: tuple[Definition[NodeState], ...] = (
    Definition("bms_fleet_server_up", "1 while nats-server and its streams are available", lambda s: s.is_healthy),
    Definition(
        "bms_fleet_server_connections", "Open connections, including MQTT", lambda s: s.monitored("connections")
    ),
    Definition(
        "bms_fleet_server_connections_opened_total",
        "Connections since the start of nats-server",
        lambda s: s.monitored("total_connections"),
    ),
    Definition(
        "bms_fleet_server_slow_consumers_total",
        "Clients that nats-server disconnected because they read too slowly",
        lambda s: s.monitored("slow_consumers"),
    ),
    Definition(
        "bms_fleet_server_resident_memory_bytes", "Resident memory of nats-server", lambda s: s.monitored("mem")
    ),
    Definition(
        "bms_fleet_server_storage_bytes",
        "Size of all streams on this node",
        lambda s: s.monitored("jetstream", "stats", "storage"),
    ),
    Definition(
        "bms_fleet_server_storage_max_bytes",
        "Maximum size of all streams on this node",
        lambda s: s.monitored("jetstream", "config", "max_storage"),
    ),
    Definition("bms_fleet_disk_bytes", "Size of the file system with the streams", lambda s: s.disk_bytes),
    Definition(
        "bms_fleet_disk_free_bytes", "Free space of the file system with the streams", lambda s: s.disk_free_bytes
    ),
)
"""Metrics of the node."""

TENANT: tuple[Definition[TenantState], ...] = (
    Definition("bms_fleet_workers", "Workers with a heartbeat in the last 5 s", lambda s: len(s.heartbeats)),
    Definition(
        "bms_fleet_unowned_partitions",
        "Partitions with undelivered messages that no worker owns",
        lambda s: None if s.unowned is None else len(s.unowned),
    ),
    Definition(
        "bms_fleet_refused_partitions",
        "Partitions that no worker owns because a worker cannot read the checkpoint",
        lambda s: len(s.refused),
    ),
    Definition(
        "bms_fleet_undelivered_messages",
        "Messages of RAW that the server has not delivered to a worker yet",
        lambda s: None if s.undelivered is None else sum(s.undelivered.values()),
    ),
    Definition(
        "bms_fleet_unsaved_ratio",
        "Part of RAW that no checkpoint includes, by size or age, whichever is larger; computed once a minute",
        lambda s: s.unsaved_share,
    ),
    Definition(
        "bms_fleet_silent_packs",
        "Packs of the table of which no hourly summary has arrived for 3 h; computed once a minute",
        lambda s: s.problems and s.problems.silent,
    ),
    Definition(
        "bms_fleet_alarm_packs",
        "Packs of the table with the alarm weak_cell or cell_short in the last hourly summary; computed once a minute",
        lambda s: s.problems and s.problems.alarms,
    ),
    Definition("bms_fleet_mqtt_sessions", "MQTT sessions, including those of disconnected edges", _mqtt_sessions),
    Definition(
        "bms_fleet_stream_messages", "Stored messages of a stream", _each_stream(lambda s: s.messages), "stream"
    ),
    Definition("bms_fleet_stream_bytes", "Size of a stream", _each_stream(lambda s: s.stored_bytes), "stream"),
    Definition("bms_fleet_stream_max_bytes", "Maximum size of a stream", _each_stream(lambda s: s.max_bytes), "stream"),
)
"""Metrics of a tenant."""

WORKER: tuple[Definition[Heartbeat], ...] = (
    Definition("bms_fleet_worker_info", "Version of the worker; always 1", lambda h: {h.version: 1.0}, "version"),
    Definition("bms_fleet_worker_start_time_seconds", "Start of the worker, since 1970", lambda h: h.started_s),
    Definition("bms_fleet_worker_partitions", "Claimed partitions", lambda h: len(h.partitions)),
    Definition("bms_fleet_worker_refused_partitions", "Refused partitions", lambda h: len(h.refused)),
    Definition("bms_fleet_worker_packs", "Packs in the claimed partitions", lambda h: h.packs),
    Definition("bms_fleet_worker_unknown_packs", "Packs that are missing in the table", lambda h: h.unknown_count),
    Definition(
        "bms_fleet_worker_clock_error_packs", "Packs whose edge's clock is wrong", lambda h: h.clock_error_count
    ),
    Definition("bms_fleet_worker_blocks_total", "Processed blocks", lambda h: h.blocks),
    Definition("bms_fleet_worker_samples_total", "Processed samples", lambda h: h.samples),
    Definition("bms_fleet_worker_faults_total", "Blocks skipped because of an internal error", lambda h: h.faults),
    Definition("bms_fleet_worker_dead_letters_total", "Blocks that became dead letters", lambda h: h.dead_letters),
    Definition("bms_fleet_worker_events_total", "Events by kind", lambda h: h.events, "event"),
    Definition(
        "bms_fleet_worker_lag_seconds",
        "Largest time from the last sample of a block to its estimate, in the last minute",
        lambda h: h.lag_s,
    ),
    Definition(
        "bms_fleet_worker_waiting_messages", "Received messages that are not processed yet", lambda h: h.waiting
    ),
    Definition(
        "bms_fleet_worker_waiting_summaries",
        "Hourly summaries, messages of histories and dead letters that are not acknowledged yet",
        lambda h: h.hours_waiting,
    ),
    Definition(
        "bms_fleet_worker_unsaved_seconds",
        "Largest time for which a partition has had blocks that its last checkpoint does not include",
        lambda h: h.unsaved_s,
    ),
    Definition(
        "bms_fleet_worker_checkpoint_duration_seconds", "Duration of the last checkpoint", lambda h: h.checkpoint_s
    ),
    Definition("bms_fleet_worker_cpu_seconds_total", "CPU time of the process", lambda h: h.cpu_s),
    Definition("bms_fleet_worker_estimation_seconds_total", "CPU time of the estimation", lambda h: h.estimation_s),
    Definition("bms_fleet_worker_resident_memory_bytes", "Memory of the process", lambda h: MIB * h.rss_mib),
    Definition("bms_fleet_worker_reconnects_total", "Reconnections to the server", lambda h: h.reconnects),
    Definition(
        "bms_fleet_worker_trouble",
        "1 while the worker reports an error, which status and page show",
        lambda h: bool(h.trouble),
    ),
)
"""Metrics of a worker, since its start."""


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
