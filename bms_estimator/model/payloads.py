"""Published payloads: estimate, parameters, health and info of one pack.

Every number that can be missing is ``None`` and never NaN: the payloads are JSON. The field descriptions
are published as JSON schema.
"""

from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

FRESH_PERIODS = 3
"""Number of periods without an accepted sample after which values are stale; the longer one of publish and sample
period."""

PAYLOAD_VERSION = 1
"""Version of all payloads; ``sinks/mqtt/topics.py`` says when it is raised."""


class Payload(BaseModel):
    """Base of all published values."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


_COUNTED = "at the terminals over all runs, up to the last checkpoint where there is one; it never decreases"


class Estimate(Payload):
    """Topic ``state``: one publish window. V, I, P and temperature are means over the window, the rest is its last sample."""

    time: str = Field(description="arrival of the window's last sample, ISO 8601, UTC")
    publish_time: str = Field(description="when this message was made, ISO 8601, UTC")
    board_time_s: float = Field(description="the stream's own clock at the last sample [s]")
    voltage_v: float = Field(description="pack terminal voltage [V], mean")
    current_a: float = Field(description="current [A], positive on discharge, mean")
    power_w: float = Field(description="voltage times current [W], positive on discharge, mean of the products")
    temperature_c: float | None = Field(description="temperature [C], mean; null without a sensor")
    cell_lowest_v: float | None = Field(description="lowest voltage of a single cell [V], last; null without any")
    cell_highest_v: float | None = Field(description="highest voltage of a single cell [V], last; null without any")
    cell_lowest: int | None = Field(description="which cell that is, from 1")
    cell_highest: int | None = Field(description="which cell that is, from 1")
    cells_v: list[float | None] | None = Field(
        description="voltages of single cells [V], last; null where one is not known, and without any"
    )
    soc: float | None = Field(description="state of charge, 0..1; null of a fuel cell, as all that follows from it")
    soc_percent: float | None = Field(description="state of charge [%]")
    soc_std: float | None = Field(
        description="standard deviation of soc; with cells in series as of the emptiest, which may lie below by a tenth of what is "
        "drawn; null without the identifier"
    )
    soc_coulomb: float | None = Field(description="state of charge by coulomb counting alone, 0..1")
    soc_ocv: float | None = Field(description="state of charge by the inverted OCV (7.1), 0..1")
    remaining_capacity_ah: float | None = Field(description="charge down to SOC 0 [Ah]")
    usable_capacity_ah: float | None = Field(description="charge down to max(delta_1, delta_2) [Ah]")
    remaining_energy_wh: float | None = Field(description="energy at the terminals down to SOC 0 at current_a [Wh]")
    time_to_empty_s: float | None = Field(description="down to SOC 0 at current_a [s]; null unless it discharges")
    time_to_full_s: float | None = Field(description="up to SOC 1 at current_a [s]; null unless it charges")
    charge_out_ah: float = Field(description=f"discharged {_COUNTED} [Ah]")
    charge_in_ah: float = Field(description=f"charged {_COUNTED} [Ah]")
    energy_out_kwh: float = Field(description=f"discharged {_COUNTED} [kWh]")
    energy_in_kwh: float = Field(description=f"charged {_COUNTED} [kWh]")
    equivalent_cycles: float | None = Field(description="charge_out_ah over the rated capacity; null of a fuel cell")
    voltage_estimate_v: float | None = Field(description="the observer's terminal voltage [V]")
    innovation_v: float | None = Field(description="measured less predicted voltage before the correction [V]")
    tracking_error_v: float | None = Field(description="the observer's e (3.15) [V]")
    delta_1: float | None = Field(description="SOC below which C_ts is negative (2.11)")
    delta_2: float | None = Field(description="SOC below which C_tl is negative (2.12)")
    delta_configured: bool = Field(
        description="delta_1 and delta_2 are constants of the cell file, because the learning law leaves the shape of C_ts "
        "and C_tl over SOC as it is"
    )
    stability_margin: float | None = Field(description="soc - max(delta_1, delta_2)")
    adaptive_gain_k: float | None = Field(description="k of (3.13) [V^2 s]")
    nussbaum_gain: float | None = Field(description="N(k) of (3.12); null with the learning law, which has none")
    adaptation_gain_hz: float | None = Field(description="gamma k of the learning law [1/s]; null with a printed law")
    converged: bool = Field(description="|tracking_error_v| is below eps2 of Algorithm 1")
    lock: bool = Field(description="the observer tracks the measured voltage")
    frames_received: int = Field(description="valid frames since start")
    frames_lost: int = Field(description="frames missing from the sequence since start")
    crc_errors: int = Field(description="frames with a wrong checksum since start")
    sample_rate_hz: float | None = Field(description="samples per second of the stream's clock in the window [Hz]")


class Parameter(Payload):
    """One parameter with what is known of it."""

    value: float | None = Field(description="in the unit of its name; a1..a21 in SI as in the thesis")
    std: float | None = Field(description="standard deviation, same unit; null when unknown")
    valid: bool = Field(description="the value rests on data or configuration that may be relied on")
    source: Literal["configured", "identified"]
    updated: str | None = Field(default=None, description="when data last told of it, ISO 8601, UTC")
    reason: str | None = Field(default=None, description="why not valid, with the numbers")


class OcvCurve(Payload):
    """The open-circuit voltage at 25 C over SOC, as it is used now."""

    soc: list[float] = Field(description="0, 0.05 ... 1")
    ocv_v: list[float] = Field(description="of the pack [V]: of the cell file, and what was learned on top of it")
    std_v: list[float] = Field(description="standard deviation of ocv_v [V]")


class ParameterReport(Payload):
    """Topic ``parameters``: a1..a21 and the elements at the present SOC."""

    publish_time: str = Field(description="when this message was made, ISO 8601, UTC")
    soc: float | None = Field(description="state of charge the elements belong to, 0..1")
    a: dict[str, Parameter] = Field(description="a1..a21 of (2.5)-(2.10); empty of a fuel cell")
    ocv: OcvCurve | None = Field(description="null before the first sample, and without the identifier")
    elements: dict[str, Parameter] = Field(
        description="r_s_ohm, r_ts_ohm, c_ts_farad, r_tl_ohm, c_tl_farad, e_o_v; of a fuel cell the values of its file"
    )
    state_of_health: dict[str, Parameter] = Field(
        description="capacity and r_s over those of the cell file: 1 is as new; r_s at the same SOC and temperature; "
        "current_offset_a: what the current sensor shows at no current [A]"
    )


class LoopHealth(Payload):
    """Delays of the event loop, and their causes."""

    latency_p50_s: float | None = Field(
        description="from the arrival of bytes to their estimate since the last health, median [s]; null without samples"
    )
    latency_p99_s: float | None = Field(description="the same, 99 of 100 are shorter [s]")
    latency_max_s: float | None = Field(description="the same, longest [s]")
    reads_waiting: int = Field(description="reads of the line that wait for the estimator")
    messages_waiting: int = Field(description="states and events that the broker has not acknowledged yet")
    log_lines_lost: int = Field(description="lines of the log that nobody has read, since start")
    disk_free_mib: float | None = Field(
        description="where the state is kept, at the last checkpoint [MiB]; null before, and without"
    )


class RecordingHealth(Payload):
    """The recording of the board's raw bytes."""

    on: bool = Field(description="false: it has ended, the log says why")
    bytes: int = Field(description="of the line, taken so far")
    missed_reads: int = Field(description="reads that are not in the file")


class EdgeHealth(Payload):
    """Blocks of raw samples on their way to a fleet's server."""

    blocks_kept: int = Field(description="on disk or in memory, for no worker has said yet that they are safe")
    blocks_unsent: int = Field(description="of these, those that the server has not acknowledged")
    blocks_dropped: int = Field(description="that found no room or could not be read, since start")
    trouble: str | None = Field(description="why the server was lost or could not be reached last; null: never")


class HookHealth(Payload):
    """Alarm hooks, since start."""

    done: int = Field(description="programs that ended with exit code 0, messages that were published")
    failures: int = Field(
        description="failed attempts: a program not started, killed or with another exit code, a level that the board did "
        "not take"
    )
    failing: list[str] = Field(description="hooks whose last attempt failed, each with its reason")


class Totals(Payload):
    """Totals over restarts; those after the last checkpoint before a kill are missing."""

    since: str = Field(description="when counting began, ISO 8601, UTC")
    crashes: int = Field(description="starts after a run that had not ended cleanly: a fault, a kill, a power cut")
    samples: dict[str, int] = Field(description="samples accepted and dropped by kind")
    unseen_s: float = Field(description="in gaps and between runs, as far as its length was known [s]")
    charge_out_ah: float = Field(default=0.0, description="discharged at the terminals [Ah]")
    charge_in_ah: float = Field(default=0.0, description="charged [Ah]")
    energy_out_kwh: float = Field(default=0.0, description="discharged [kWh]")
    energy_in_kwh: float = Field(default=0.0, description="charged [kWh]")


class Health(Payload):
    """Topic ``health``, retained: how the service and the line are."""

    publish_time: str = Field(description="when this message was made, ISO 8601, UTC")
    uptime_s: float = Field(description="since the service started [s]")
    rss_mib: float | None = Field(description="resident memory [MiB]")
    loop_lag_s: float = Field(description="how late the event loop woke at worst since the last health [s]")
    restarts: int = Field(description="starts that found a checkpoint of an earlier run")
    reconnects: int = Field(description="times the source was opened again")
    sensor_online: bool = Field(description="a valid frame came within 3 publish or sample periods")
    sensor_message: str | None = Field(description="why the sensor is not online; null when it is")
    clock_ppm: float | None = Field(
        description="how much faster the board's clock runs than the host's [1e-6]; null while unknown"
    )
    line: dict[str, int] = Field(description="frames and faults of the line by kind, since start")
    samples: dict[str, int] = Field(description="samples accepted and dropped by kind, since start")
    identifier: dict[str, int] = Field(
        description="samples the identifier did not believe, and its resets, since start"
    )
    suspects: list[str] = Field(description="what the identifier suspects of its input, and what to do; empty: nothing")
    lock_losses: int = Field(description="times the observer lost track")
    gain_rearms: int = Field(description="times k was started again before the gain turned")
    publish_drops: int = Field(description="states and events that found no room, or that the broker refused")
    publish_waiting: int = Field(description="states and events that the broker has not acknowledged yet")
    store_trouble: str | None = Field(
        description="why the disk does not keep what waits, nor the history; null: it does, or nothing is to be kept"
    )
    broker_losses: int = Field(description="connections to a broker that were lost, since start")
    broker_trouble: str | None = Field(
        description="why a broker was lost or could not be reached last; null: never since start"
    )
    refused_topics: list[str] = Field(description="what the broker denies, as far as it can be told; empty: nothing")
    availability_corrections: int = Field(description="times somebody else wrote an availability and was put right")
    requests: dict[str, int] = Field(description="by what became of them, since start")
    checkpoint: str = Field(description="what became of the last checkpoint")
    loop: LoopHealth
    recording: RecordingHealth | None = Field(description="null: nothing is recorded")
    edge: EdgeHealth | None = Field(default=None, description="null: no raw samples are sent")
    hooks: HookHealth | None = Field(default=None, description="null: there is no alarm hook")
    unseen_s: float | None = Field(
        description="how long nobody measured in the last gap of the samples or before the start [s]; "
        "null: never since the start, or nobody knows"
    )
    total: Totals = Field(description="what is counted since the checkpoint began, over restarts")


class Info(Payload):
    """Topic ``info``, retained: what this is."""

    device: str
    version: str = Field(description="of bms_estimator")
    payload_version: int = Field(
        description="of what is published: goes up when a field vanishes or gets another type, unit or meaning"
    )
    started: str = Field(description="ISO 8601, UTC")
    cell: str
    capacity_ah: float | None = Field(description="null of a fuel cell")
    series_count: int
    nominal_voltage_v: float
    observer: str = Field(description="adaptation law, and which N(k) is the gain of a printed one")
    temperature_sensor: bool = Field(
        description="a cell temperature came; without any 25 C is taken, and the resistances are less sure"
    )
    publish_rate_hz: float
    board: dict[str, str] = Field(description="what the board said of itself; empty until it did")


class Alarm(Payload):
    """Topic ``alarm/<name>``, retained: one alarm of a pack, raised or not."""

    name: str = Field(description="as in the topic and in [alarms]")
    severity: Literal["warning", "critical"]
    active: bool = Field(description="raised, and neither cleared nor, where it latches, acknowledged")
    latched: bool = Field(description="the cause is gone, but it stays until it is acknowledged")
    since: str | None = Field(description="when it was raised, ISO 8601, UTC; null unless active")
    value: float | None = Field(
        description="what was measured when it was raised, in unit; null where there is no number"
    )
    limit: float | None = Field(description="what it may reach, in unit; null where there is no number")
    unit: str | None = Field(description="of value and limit")
    text: str = Field(description="for people: what is wrong, and what to do; empty unless active")
    watched: bool = Field(
        default=True,
        description="false: what the alarm needs was measured before and is missing, so it cannot be raised",
    )
    unwatched_reason: str | None = Field(default=None, description="why it is not watched; null while it is")


class Snapshot(NamedTuple):
    """All that a sink may want at one publish time."""

    estimate: Estimate | None
    """Estimate of the window; None without a sample."""
    parameters: ParameterReport
    health: Health
    info: Info
    alarms: tuple[Alarm, ...] = ()
    """All monitored limits, raised or not."""
