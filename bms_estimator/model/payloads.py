"""Published payloads: estimate, parameters, health and info of one pack.

A missing number is ``None``, because JSON has no NaN. The field descriptions are published as JSON schema.
"""

from functools import cached_property
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field

from bms_estimator.model.quantity import (
    FAST_INTERVAL_S,
    Entity,
    Quantity,
    counter_entity,
    raw_entity,
    total_entity,
)

FRESH_PERIODS = 3
"""Number of periods without an accepted sample after which values are stale. The period is the longer one of publish and
sample period."""

PAYLOAD_VERSION = 2
"""Version of all payloads; ``sinks/mqtt/topics.py`` defines when it increases."""


class Payload(BaseModel):
    """Base of all published values."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @cached_property
    def json_bytes(self) -> bytes:
        """JSON text, serialized once for all sinks."""
        return self.model_dump_json().encode()

    def __copy__(self) -> Self:
        """Copy without the cached JSON, because ``model_copy`` changes fields afterwards."""
        copied = super().__copy__()
        copied.__dict__.pop("json_bytes", None)
        return copied


_COUNTED = "at the terminals over all runs, up to the last checkpoint where there is one; it never decreases"


class Estimate(Payload):
    """Topic ``state``: one publish window. V, I, P and temperature are means over the window, the rest is its last sample."""

    time: str = Field(description="arrival time of the window's last sample, ISO 8601, UTC")
    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    board_time_s: Annotated[float, Quantity(prometheus="none")] = Field(
        description="source's clock at the last sample [s]"
    )
    voltage_v: Annotated[float, Quantity(Entity(None, "V", 2, 0.02, "voltage", FAST_INTERVAL_S, is_primary=True))] = (
        Field(description="mean pack terminal voltage [V]")
    )
    current_a: Annotated[
        float, Quantity(Entity(None, "A", 2, 0.05, "current", FAST_INTERVAL_S, is_primary=True, signed=True))
    ] = Field(description="mean current [A], positive on discharge")
    power_w: Annotated[
        float, Quantity(Entity(None, "W", 1, 0.5, "power", FAST_INTERVAL_S, is_primary=True, signed=True))
    ] = Field(description="mean of voltage times current [W], positive on discharge")
    temperature_c: Annotated[float | None, Quantity(Entity(None, "°C", 1, 0.3, "temperature", is_primary=True))] = (
        Field(description="mean temperature [C]; null without a sensor")
    )
    cell_lowest_v: Annotated[
        float | None, Quantity(Entity("Lowest cell, voltage", "V", 3, 0.005, "voltage"), packs="with cell voltages")
    ] = Field(description="lowest cell voltage at the last sample [V]; null without cell voltages")
    cell_highest_v: Annotated[
        float | None, Quantity(raw_entity("Highest cell, voltage", "V", 3, "voltage"), packs="with cell voltages")
    ] = Field(description="highest cell voltage at the last sample [V]; null without cell voltages")
    cell_lowest: Annotated[
        int | None, Quantity(Entity("Lowest cell", None, 0, 1.0, state_class=None), packs="with cell voltages")
    ] = Field(description="number of the lowest cell, from 1")
    cell_highest: Annotated[
        int | None,
        Quantity(Entity("Highest cell", None, 0, 1.0, enabled=False, state_class=None), packs="with cell voltages"),
    ] = Field(description="number of the highest cell, from 1")
    cells_v: list[float | None] | None = Field(
        description="cell voltages at the last sample [V]; null for an unknown cell, or without cell voltages"
    )
    soc: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="state of charge, 0..1; null for a fuel cell, like all values derived from it"
    )
    soc_percent: Annotated[
        float | None,
        Quantity(
            Entity(None, "%", 1, 0.2, "battery", is_primary=True, immediate_step=2.0),
            packs="batteries",
            prometheus="none",
        ),
    ] = Field(description="state of charge [%]")
    soc_std: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="standard deviation of soc; for cells in series it includes the weakest cell, a tenth of the "
        "charge drawn; null without the identifier"
    )
    soc_coulomb: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="state of charge by coulomb counting alone, 0..1"
    )
    soc_ocv: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="state of charge by the inverted OCV (7.1), 0..1; null if the last sample had no new voltage"
    )
    remaining_capacity_ah: Annotated[
        float | None, Quantity(Entity("Remaining capacity", "Ah", 2, 0.02, is_primary=True), packs="batteries")
    ] = Field(description="remaining charge to SOC 0 [Ah]")
    remaining_energy_wh: Annotated[
        float | None,
        Quantity(Entity("Remaining energy", "Wh", 1, 0.2, "energy_storage", is_primary=True), packs="batteries"),
    ] = Field(description="remaining energy at the terminals to SOC 0 at current_a [Wh]")
    time_to_cutoff_s: float | None = Field(
        description="median time until the load is switched off at the cut-off voltage [s], under a load like the one seen; "
        "below 600 s use the quantiles and probabilities; null with a forecast_reason"
    )
    time_to_cutoff_p05_s: float | None = Field(description="5 % quantile of this time [s]")
    time_to_cutoff_p95_s: float | None = Field(description="95 % quantile of this time [s]")
    cutoff_within_2min: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="probability that the load is switched off within 2 min of the forecast, 0..1"
    )
    cutoff_within_5min: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="probability that the load is switched off within 5 min of the forecast, 0..1"
    )
    cutoff_within_15min: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="probability that the load is switched off within 15 min of the forecast, 0..1"
    )
    time_to_full_s: float | None = Field(description="time until the charger ends the charge [s]; null unless charging")
    usable_capacity_ah: Annotated[
        float | None, Quantity(Entity("Usable capacity", "Ah", 2, 0.02, is_primary=True), packs="batteries")
    ] = Field(description="remaining charge to the cut-off voltage at the present load and temperature [Ah]")
    available_discharge_power_10s_w: Annotated[
        float | None,
        Quantity(Entity("Available discharge power, 10 s", "W", 0, 5.0, "power", is_primary=True), packs="batteries"),
    ] = Field(description="constant power that the pack supplies for 10 s [W]")
    available_discharge_power_60s_w: Annotated[
        float | None, Quantity(raw_entity("Available discharge power, 60 s", "W", 0, "power"), packs="batteries")
    ] = Field(description="constant power that the pack supplies for 60 s [W]")
    available_charge_power_10s_w: Annotated[
        float | None,
        Quantity(Entity("Available charge power, 10 s", "W", 0, 5.0, "power", is_primary=True), packs="batteries"),
    ] = Field(description="constant power that the pack accepts for 10 s [W]")
    available_charge_power_60s_w: Annotated[
        float | None, Quantity(raw_entity("Available charge power, 60 s", "W", 0, "power"), packs="batteries")
    ] = Field(description="constant power that the pack accepts for 60 s [W]")
    forecast_reason: str | None = Field(
        description="reason why time_to_cutoff_s and its quantiles are null; null if they have values"
    )
    weakest_cell_soc: Annotated[
        float | None, Quantity(Entity("Weakest cell, SOC", None, 3, 0.01), packs="batteries", prometheus="ratio")
    ] = Field(
        description="SOC of the weakest cell, 0..1: by the cell voltages, or without them by the voltage of the bank; null for a single cell, "
        "and before the first comparison",
    )
    weakest_cell_soc_std: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="standard deviation of weakest_cell_soc"
    )
    weakest_cell_capacity: Annotated[
        float | None,
        Quantity(Entity("Weakest cell, capacity", None, 2, 0.01), packs="batteries", prometheus="ratio"),
    ] = Field(description="capacity of the weakest cell relative to the other cells")
    usable_capacity_to_weakest_ah: Annotated[
        float | None, Quantity(raw_entity("Usable capacity to the weakest cell", "Ah", 2), packs="batteries")
    ] = Field(description="remaining charge until the weakest cell is empty [Ah]")
    weakest_cell: Annotated[
        int | None, Quantity(Entity("Weakest cell", None, 0, 1.0, state_class=None), packs="with cell voltages")
    ] = Field(
        description="number of the cell with the lowest SOC, from 1; null before the first estimate of the cells, and "
        "without cell voltages",
    )
    cell_soc_spread: Annotated[
        float | None, Quantity(Entity("Cell spread, SOC", None, 3, 0.005), packs="with cell voltages")
    ] = Field(description="highest less lowest SOC of the cells; null as weakest_cell")
    cell_r_spread: Annotated[
        float | None, Quantity(Entity("Cell spread, resistance", None, 2, 0.02), packs="with cell voltages")
    ] = Field(
        description="highest less lowest resistance of the cells, relative to their median; null as weakest_cell",
    )
    charge_out_ah: Annotated[
        float, Quantity(total_entity("Charge out", "Ah", 2)._replace(enabled=False), prometheus="counter")
    ] = Field(description=f"discharged {_COUNTED} [Ah]")
    charge_in_ah: Annotated[
        float, Quantity(total_entity("Charge in", "Ah", 2)._replace(enabled=False), prometheus="counter")
    ] = Field(description=f"charged {_COUNTED} [Ah]")
    energy_out_kwh: Annotated[float, Quantity(total_entity("Energy out", "kWh", 3, "energy"), prometheus="counter")] = (
        Field(description=f"discharged {_COUNTED} [kWh]")
    )
    energy_in_kwh: Annotated[float, Quantity(total_entity("Energy in", "kWh", 3, "energy"), prometheus="counter")] = (
        Field(description=f"charged {_COUNTED} [kWh]")
    )
    equivalent_cycles: Annotated[
        float | None, Quantity(total_entity("Equivalent cycles", None, 2), packs="batteries")
    ] = Field(description="charge_out_ah divided by the rated capacity; null for a fuel cell")
    voltage_estimate_v: Annotated[float | None, Quantity(raw_entity("Estimated voltage", "V", 2, "voltage"))] = Field(
        description="terminal voltage of the observer, (4.1) [V]"
    )
    innovation_v: Annotated[float | None, Quantity(raw_entity("Innovation", "V", 3, "voltage"))] = Field(
        description="measured minus predicted voltage before the correction [V]"
    )
    tracking_error_v: float | None = Field(description="tracking error e of the observer, (3.15) [V]")
    delta_1: Annotated[
        float | None, Quantity(raw_entity("delta 1", None, 4), packs="batteries", prometheus="ratio")
    ] = Field(description="SOC below which C_ts is negative, (2.11)")
    delta_2: Annotated[
        float | None, Quantity(raw_entity("delta 2", None, 4), packs="batteries", prometheus="ratio")
    ] = Field(description="SOC below which C_tl is negative, (2.12)")
    delta_configured: bool = Field(
        description="true: delta_1 and delta_2 are constants of the cell file, because the learning law does not change the "
        "shape of C_ts and C_tl over SOC"
    )
    stability_margin: Annotated[
        float | None, Quantity(raw_entity("Stability margin", None, 3), packs="batteries", prometheus="ratio")
    ] = Field(description="soc - max(delta_1, delta_2)")
    adaptive_gain_k: Annotated[float | None, Quantity(raw_entity("Adaptive gain k", "V²s", 6))] = Field(
        description="adaptive gain state k, (3.13) [V^2 s]"
    )
    nussbaum_gain: Annotated[float | None, Quantity(raw_entity("Nussbaum gain", None, 3), packs="batteries")] = Field(
        description="N(k), (3.12); null with the learning law"
    )
    adaptation_gain_hz: Annotated[float | None, Quantity(raw_entity("Adaptation gain", "1/s", 4))] = Field(
        description="gamma k of the learning law [1/s]; null with a law of the thesis"
    )
    converged: bool = Field(description="|tracking_error_v| is below eps2 of Algorithm 1")
    lock: bool = Field(description="the observer tracks the measured voltage")
    frames_received: Annotated[int, Quantity(prometheus="counter")] = Field(description="valid frames since start")
    frames_lost: Annotated[int, Quantity(counter_entity("Frames lost"), prometheus="counter")] = Field(
        description="missing frames by sequence number since start"
    )
    crc_errors: Annotated[int, Quantity(counter_entity("CRC errors"), prometheus="counter")] = Field(
        description="frames with a wrong checksum since start"
    )
    sample_rate_hz: Annotated[float | None, Quantity(raw_entity("Sample rate", "Hz", 1, "frequency"))] = Field(
        description="sample rate on the source's clock in the window [Hz]"
    )


class Parameter(Payload):
    """One parameter with its error and validity."""

    value: float | None = Field(description="value in the unit of its name; a1..a21 in SI units as in the thesis")
    std: float | None = Field(description="standard deviation in the same unit; null if unknown")
    valid: bool = Field(description="true: the value is supported by data or configured")
    source: Literal["configured", "identified"]
    updated: str | None = Field(default=None, description="time of the last informative data, ISO 8601, UTC")
    reason: str | None = Field(default=None, description="reason why the value is not valid, with numbers")


class OcvCurve(Payload):
    """Open-circuit voltage at 25 C over SOC, as presently used."""

    soc: list[float] = Field(description="SOC 0, 0.05 ... 1")
    ocv_v: list[float] = Field(
        description="open-circuit voltage of the pack [V]: that of the cell file with the learned correction"
    )
    std_v: list[float] = Field(description="standard deviation of ocv_v [V]")


class ParameterReport(Payload):
    """Topic ``parameters``: a1..a21 and the elements at the present SOC."""

    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    soc: float | None = Field(description="SOC to which the elements belong, 0..1")
    a: dict[str, Parameter] = Field(description="a1..a21 of (2.5)-(2.10); empty for a fuel cell")
    ocv: OcvCurve | None = Field(
        description="open-circuit voltage; null before the first sample and without the identifier"
    )
    elements: dict[str, Parameter] = Field(
        description="r_s_ohm, r_ts_ohm, c_ts_farad, r_tl_ohm, c_tl_farad, e_o_v; for a fuel cell the values of its file"
    )
    state_of_health: dict[str, Parameter] = Field(
        description="capacity and r_s relative to the cell file (1: as new), r_s at the same SOC and temperature; "
        "current_offset_a: offset of the current sensor [A]"
    )


class LoopHealth(Payload):
    """Delays of the event loop, and their causes."""

    latency_p50_s: float | None = Field(
        description="median delay from the arrival of bytes to their estimate since the last health message [s]; null without samples"
    )
    latency_p99_s: float | None = Field(description="99th percentile of this delay [s]")
    latency_max_s: float | None = Field(description="maximum of this delay [s]")
    reads_waiting: int = Field(description="chunks that wait for the estimator")
    messages_waiting: int = Field(description="states and events that the broker has not acknowledged")
    log_lines_lost: int = Field(description="dropped log lines since start")
    disk_free_mib: float | None = Field(
        description="free space in the state folder at the last checkpoint [MiB]; null before, and without a state folder"
    )


class RecordingHealth(Payload):
    """The recording of the board's raw bytes."""

    on: bool = Field(description="false: the recording has ended; the log has the reason")
    bytes: int = Field(description="bytes recorded")
    missed_reads: int = Field(description="chunks missing in the recording")


class EdgeHealth(Payload):
    """Blocks of raw samples on their way to a fleet's server."""

    blocks_kept: int = Field(description="blocks on disk or in memory that no worker has confirmed")
    blocks_unsent: int = Field(description="stored blocks that the server has not acknowledged")
    blocks_dropped: int = Field(
        description="blocks dropped since start because the store was full or they could not be read"
    )
    trouble: str | None = Field(description="reason of the last lost or failed connection; null: none")


class HookHealth(Payload):
    """Alarm hooks, since start."""

    done: int = Field(description="programs that ended with exit code 0, and published messages")
    failures: int = Field(
        description="failed runs: a program that was not started, was killed or returned another exit code, or a relay level that the board "
        "rejected"
    )
    failing: list[str] = Field(description="hooks whose last run failed, with the reason")


class Totals(Payload):
    """Totals over restarts; those after the last checkpoint before a kill are missing."""

    since: str = Field(description="start of counting, ISO 8601, UTC")
    crashes: int = Field(description="starts after a run that did not end cleanly (fault, kill, power failure)")
    samples: dict[str, int] = Field(description="accepted and dropped samples by kind")
    unseen_s: float = Field(description="total time in gaps and between runs, if the length was known [s]")
    charge_out_ah: float = Field(default=0.0, description="charge discharged at the terminals [Ah]")
    charge_in_ah: float = Field(default=0.0, description="charge charged at the terminals [Ah]")
    energy_out_kwh: float = Field(default=0.0, description="energy discharged at the terminals [kWh]")
    energy_in_kwh: float = Field(default=0.0, description="energy charged at the terminals [kWh]")


class AnchorReport(Payload):
    """The last end of a charge or discharge that defines SOC 1 or 0."""

    kind: Literal["full", "empty"] = Field(
        description="full: the charger ended at the full voltage; empty: the protection ended at the cut-off voltage"
    )
    soc_before: float = Field(description="SOC before the correction, 0..1")
    soc_std_before: float = Field(description="standard deviation of soc_before")
    soc_after: float = Field(
        description="SOC after the correction, 0..1; equal to soc_before if the OCV curve contradicts the configured voltage"
    )


class FitReport(Payload):
    """Change of the estimates by a fit of the pack's model."""

    soc_before: float = Field(description="SOC before the fit was adopted, 0..1")
    soc_after: float = Field(description="SOC after the fit was adopted, 0..1")
    capacity_before_ah: float = Field(description="capacity before the fit was adopted [Ah]")
    capacity_after_ah: float = Field(description="capacity after the fit was adopted [Ah]")


class PackModelHealth(Payload):
    """Fit of the pack's model to its history; counters since start."""

    fits: int = Field(description="adopted fits")
    late: int = Field(description="fits that were not done when due and were adopted at a later sample")
    failed: int = Field(description="fits that ended with an error, which the log describes")
    changes: int = Field(
        description="fits that changed the SOC, or the capacity relative to the rated one, by more than 0.01"
    )
    rows: int = Field(description="rows of the history")
    segments: int = Field(description="uninterrupted measurements in the history")
    history_days: float = Field(
        description="time from the first to the last row, without gaps of unknown duration [days]"
    )
    capacity_ah: float | None = Field(description="learned capacity of the pack [Ah]; null before the first sample")
    capacity_std_ah: float | None = Field(description="standard deviation of capacity_ah [Ah]")
    last_fit: str | None = Field(description="time at which the last fit ended, ISO 8601, UTC; null: none since start")
    last_fit_s: float | None = Field(description="duration of the last fit [s]")
    change: FitReport | None = Field(description="the last of the changes; null: none since start")


class Health(Payload):
    """Topic ``health``, retained: state of the service and the source."""

    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    uptime_s: float = Field(description="time since the service started [s]")
    rss_mib: float | None = Field(description="resident memory [MiB]")
    loop_lag_s: float = Field(description="longest delay of the event loop since the last health message [s]")
    restarts: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="starts with a checkpoint of an earlier run"
    )
    reconnects: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="number of times that the source was reopened"
    )
    sensor_online: bool = Field(description="true: a valid sample arrived within three publish or sample periods")
    sensor_message: str | None = Field(description="reason why the sensor is offline; null while online")
    clock_ppm: float | None = Field(
        description="drift of the board's clock relative to the host [1e-6], positive if fast; null while unknown"
    )
    line: dict[str, int] = Field(description="frames and faults of the source by kind, since start")
    samples: dict[str, int] = Field(description="accepted and dropped samples by kind, since start")
    identifier: dict[str, int] = Field(description="samples skipped by the identifier, and its resets, since start")
    suspects: list[str] = Field(description="input diagnostics with remedies; empty: none")
    anchor: AnchorReport | None = Field(
        default=None, description="the last end of a charge or discharge; null: none since the first start"
    )
    lock_losses: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="number of lock losses of the observer"
    )
    gain_rearms: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="number of resets of k before the gain changed its sign"
    )
    publish_drops: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="states and events dropped because the queue was full or the broker rejected them"
    )
    publish_waiting: int = Field(description="states and events that the broker has not acknowledged")
    store_trouble: str | None = Field(
        description="reason why the queue and history cannot be written; null: they can, or are not configured"
    )
    broker_losses: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="lost broker connections since start"
    )
    broker_trouble: str | None = Field(
        description="reason of the last lost or failed connection to a broker; null: none since start"
    )
    refused_topics: list[str] = Field(description="topics that the broker denies, as far as known; empty: none")
    availability_corrections: Annotated[int, Quantity(prometheus="counter")] = Field(
        description="corrections of an availability topic that another client had changed"
    )
    requests: dict[str, int] = Field(description="requests by outcome, since start")
    checkpoint: str = Field(description="outcome of the last checkpoint")
    loop: LoopHealth
    recording: RecordingHealth | None = Field(description="recording of raw bytes; null: none")
    edge: EdgeHealth | None = Field(default=None, description="blocks for a fleet's server; null: none are sent")
    hooks: HookHealth | None = Field(default=None, description="alarm hooks; null: none")
    pack_model: PackModelHealth | None = Field(
        default=None, description="fit of the pack's model; null: none, as for a fuel cell"
    )
    unseen_s: float | None = Field(
        description="length of the last gap in the samples or before the start [s]; "
        "null: no gap since the start, or unknown"
    )
    total: Totals = Field(description="totals over restarts")


class Info(Payload):
    """Topic ``info``, retained: identity of the pack and the service."""

    device: str
    version: str = Field(description="version of bms_estimator")
    payload_version: int = Field(
        description="version of the payloads; increases when a field disappears or changes its type, unit or meaning"
    )
    started: str = Field(description="start of the service, ISO 8601, UTC")
    cell: str
    capacity_ah: float | None = Field(description="rated capacity of the pack [Ah]; null for a fuel cell")
    series_count: int
    nominal_voltage_v: float
    observer: str = Field(description="adaptation law, and N(k) for a law of the thesis")
    temperature_sensor: bool = Field(
        description="true: a cell temperature was received; without one 25 C is assumed and the resistances are less certain"
    )
    publish_rate_hz: float
    board: dict[str, str] = Field(description="properties reported by the board; empty before")


class Alarm(Payload):
    """Topic ``alarm/<name>``, retained: one alarm of a pack, raised or not."""

    name: str = Field(description="name in the topic and in [alarms]")
    severity: Literal["warning", "critical"]
    active: bool = Field(description="true: raised, and not yet cleared or, if it latches, acknowledged")
    latched: bool = Field(description="true: the cause is gone, and the alarm waits for an acknowledgment")
    since: str | None = Field(description="time at which it was raised, ISO 8601, UTC; null unless active")
    value: float | None = Field(description="measured value when it was raised, in unit; null without a number")
    limit: float | None = Field(description="limit, in unit; null without a number")
    unit: str | None = Field(description="unit of value and limit")
    text: str = Field(description="description and remedy; empty unless active")
    watched: bool = Field(
        default=True,
        description="false: a required quantity was measured before and is missing, so the alarm cannot be raised",
    )
    unwatched_reason: str | None = Field(default=None, description="reason why it is not watched; null while it is")


class ForecastReport(Payload):
    """Topic ``forecast``: course of SOC and voltage until the cut-off. Each list has one value for each ``elapsed_s``."""

    time: str = Field(description="arrival time of the sample from which the forecast begins, ISO 8601, UTC")
    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    reason: str | None = Field(description="reason why the lists are empty; null if there is a forecast")
    cutoff_v: float = Field(description="voltage at which the load is switched off [V]")
    elapsed_s: list[float | None] = Field(description="time from ``time`` [s], increasing")
    soc_p05: list[float | None] = Field(description="5 % quantile of the SOC, 0..1")
    soc_p50: list[float | None] = Field(description="median of the SOC, 0..1")
    soc_p95: list[float | None] = Field(description="95 % quantile of the SOC, 0..1")
    voltage_p05_v: list[float | None] = Field(description="5 % quantile of the terminal voltage [V]")
    voltage_p50_v: list[float | None] = Field(description="median of the terminal voltage [V]")
    voltage_p95_v: list[float | None] = Field(description="95 % quantile of the terminal voltage [V]")
    survival: list[float | None] = Field(description="probability that the load is still on at this time, 0..1")


CellFaultName = Literal["internal short", "contact", "sense wire", "wrong reading", "stuck reading"]
"""Fault of a cell, or of the reading of its voltage."""


class CellReport(Payload):
    """One cell in series."""

    number: int = Field(description="number, from 1")
    soc: float = Field(description="state of charge, 0..1")
    soc_std: float = Field(description="standard deviation of soc")
    soc_deviation: float = Field(description="SOC less the mean SOC of the cells")
    soc_deviation_std: float = Field(description="standard deviation of soc_deviation")
    resistance_ratio: float = Field(description="resistance relative to the median of the cells")
    resistance_ratio_std: float = Field(description="standard deviation of resistance_ratio")
    capacity_ratio: float = Field(description="capacity relative to the median of the cells")
    self_discharge_a: float = Field(description="self-discharge current above the median of the cells [A]")
    self_discharge_std_a: float = Field(description="standard deviation of self_discharge_a [A]")
    fault: CellFaultName | None = Field(
        description="internal short: a fault of the cell; contact, sense wire, wrong reading, stuck reading: faults of the "
        "measurement of its voltage; null: none"
    )


class CellsReport(Payload):
    """Topic ``cells``, retained: comparison of the cells in series of a pack with cell voltages."""

    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    weakest: int = Field(description="number of the cell with the lowest SOC, from 1")
    cells: list[CellReport] = Field(description="all cells, from number 1 on")


class Snapshot(NamedTuple):
    """Payloads of one publication."""

    estimate: Estimate | None
    """Estimate of the window; None without a sample."""
    parameters: ParameterReport
    health: Health
    info: Info
    alarms: tuple[Alarm, ...] = ()
    """All alarms, raised or not."""
    forecast: ForecastReport | None = None
    """Curves of the last forecast; None before the first sample and without a forecaster."""
    cells: CellsReport | None = None
    """Comparison of the cells, made once a minute; None without cell voltages."""
