"""Payload of the topic ``health``, with the totals over restarts and the state of the fit of the pack's model.

A missing number is ``None``, because JSON has no NaN. The field descriptions are published as JSON schema.
"""

from functools import cached_property
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from bms_estimator.model.quantity import Quantity

PAYLOAD_VERSION = 3
"""Version of all payloads; ``sinks/mqtt/topics.py`` defines when it increases."""


class Payload(BaseModel):
    """Base class of all payloads."""

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


class FitReport(Payload):
    """Change of the estimates by a fit of the pack's model."""

    soc_before: float = Field(description="SOC before the fit was adopted, 0..1")
    soc_after: float = Field(description="SOC after the fit was adopted, 0..1")
    capacity_before_ah: float = Field(description="capacity before the fit was adopted [Ah]")
    capacity_after_ah: float = Field(description="capacity after the fit was adopted [Ah]")


class SocBound(Payload):
    """Lower bound of the standard deviation of the SOC in the use of a pack, and the change that lowers it most."""

    std: float = Field(description="smallest possible standard deviation of the SOC, mean over the use")
    change: str | None = Field(description="change of use or sensors that lowers it most; null: no change is possible")
    changed_std: float | None = Field(description="smallest possible standard deviation after this change")


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
    soc_bound: SocBound | None = Field(
        default=None,
        description="how well the SOC can be known in the present use; null before the first fit since start",
    )


class Totals(Payload):
    """Totals over restarts, without the time from the last checkpoint to a kill."""

    since: str = Field(description="start of counting, ISO 8601, UTC")
    crashes: int = Field(description="starts after a run that did not end cleanly (fault, kill, power failure)")
    samples: dict[str, int] = Field(description="accepted and dropped samples by kind")
    unseen_s: float = Field(description="total time in gaps and between runs, if the length was known [s]")
    charge_out_ah: float = Field(default=0.0, description="charge discharged at the terminals [Ah]")
    charge_in_ah: float = Field(default=0.0, description="charge charged at the terminals [Ah]")
    energy_out_kwh: float = Field(default=0.0, description="energy discharged at the terminals [kWh]")
    energy_in_kwh: float = Field(default=0.0, description="energy charged at the terminals [kWh]")


FRESH_PERIODS = 3
"""Number of periods without an accepted sample after which values are stale. The period is the longer one of publish and
sample period."""


class LoopHealth(Payload):
    """Delays of the event loop, and their causes."""

    latency_p50_s: float | None = Field(
        description="median delay from the arrival of bytes to their estimate since the last health message [s]; null without "
        "samples"
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
    trouble: str | None = Field(description="reason of the lost or failed connection; null: connected, or none failed")


class HookHealth(Payload):
    """Alarm hooks, since start."""

    done: int = Field(description="programs that ended with exit code 0, and messages that the broker has acknowledged")
    failures: int = Field(
        description="failed runs: a program that was not started, was killed or returned another exit code, a message that the "
        "broker denied or did not acknowledge in time, or a relay level that the board rejected or that a reset undid"
    )
    failing: list[str] = Field(description="hooks whose last run failed, with the reason")
    relay_resets: Annotated[int, Quantity(prometheus="counter")] = Field(
        default=0, description="resets of the board that undid a relay level"
    )


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
        description="number of times that the source was connected again"
    )
    sensor_online: bool = Field(description="true: a valid sample arrived within three publish or sample periods")
    sensor_message: str | None = Field(description="reason why the sensor is offline; null while online")
    clock_ppm: float | None = Field(
        description="drift of the board's clock relative to the host [1e-6], positive if fast; null while unknown"
    )
    line: dict[str, int] = Field(description="frames and faults of the source by kind, since start")
    samples: dict[str, int] = Field(description="accepted and dropped samples by kind, since start")
    identifier: dict[str, int] = Field(description="samples skipped by the identifier, and its resets, since start")
    suspects: list[str] = Field(
        description="input diagnostics, and settings that the device contradicts, with remedies; empty: none"
    )
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
        description="reason of the lost or failed connection to a broker; null: connected, or no attempt failed"
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
        description="length of the last gap in the samples of the estimate, which after a kill begins at the last checkpoint [s]; "
        "null: no gap since the start, or unknown"
    )
    total: Totals = Field(description="totals over restarts")
