"""Heartbeat that each worker publishes once a second on ``subjects.worker``."""

from pydantic import BaseModel, ConfigDict, Field

HEARTBEAT_S = 1.0
"""Interval of heartbeats [s]."""
DEAD_S = 3.0
"""Time without a heartbeat after which a worker counts as dead [s]."""


class RefusedPartition(BaseModel):
    """Partition that a worker does not claim, because it cannot read the last checkpoint."""

    model_config = ConfigDict(frozen=True)

    partition: int
    """Number of the partition."""
    format: int
    """Format of the last checkpoint; 0 if the pointer to it is unreadable."""


class Heartbeat(BaseModel):
    """State of a worker: its partitions, and counters since its start."""

    model_config = ConfigDict(frozen=True)

    id: str
    started_s: float
    """Wall clock at the worker's start [s since 1970]."""
    version: str = ""
    """Version of the program; empty for versions without this field."""
    checkpoint_format: int = 1
    """Newest format of checkpoints that the worker reads; versions without this field read format 1."""
    oldest_checkpoint_format: int = 1
    """Oldest format of checkpoints that the worker reads."""
    block_version: int = 1
    """Newest version of blocks that the worker reads; versions without this field read version 1."""
    refused: tuple[RefusedPartition, ...] = ()
    """Partitions that the worker does not claim, because it cannot read their last checkpoints."""
    leaving: bool = False
    """True while the worker releases its partitions before it ends."""
    partitions: tuple[int, ...] = ()
    """Numbers of the claimed partitions."""
    packs: int = 0
    """Number of packs in the claimed partitions."""
    blocks: int = 0
    """Number of processed blocks."""
    samples: int = 0
    """Number of processed samples."""
    faults: int = 0
    """Number of blocks skipped because of an internal error; the log has the tracebacks."""
    dead_letters: int = 0
    """Number of blocks that became dead letters (``nats.dead_letters``)."""
    lag_s: float | None = None
    """Largest lag since the previous heartbeat [s]: time from the arrival of a block's last sample at the edge to the
    processing of the block. None without a block."""
    counters: dict[str, int] = Field(default_factory=dict)
    """Sums of the counters of the claimed partitions, by name, such as resends, gaps and lost blocks. They are part of the
    checkpoints, so that they go on counting when another worker takes a partition over."""
    events: dict[str, int] = Field(default_factory=dict)
    """Numbers of events in this worker since its start, by name. They include partitions that it has released."""
    unknown_count: int = 0
    """Number of packs that are not in the table of packs. Their blocks are deferred."""
    unknown: tuple[str, ...] = ()
    """Names of some unknown packs."""
    clock_error_count: int = 0
    """Number of packs with a wrong clock at their edge (``worker.block_order``)."""
    clock_errors: dict[str, float] = Field(default_factory=dict)
    """Error of the edge's clock [s], positive if ahead, by pack; only the packs with the largest errors."""
    waiting: int = 0
    """Number of messages that were received from the server and not processed yet."""
    hours_waiting: int = 0
    """Number of messages, not of hours: hourly summaries, messages of histories and dead letters that the server has not
    acknowledged yet."""
    unsaved_s: float = 0.0
    """Largest time for which a partition has had blocks that its last checkpoint does not include [s]."""
    checkpoint_s: float | None = None
    """Duration of the last written checkpoint [s]; None without one."""
    cpu_s: float = 0.0
    """CPU time of the process [s]."""
    estimation_s: float = 0.0
    """CPU time of the estimation of blocks [s]; part of ``cpu_s``."""
    rss_mib: float = 0.0
    """Memory of the process [MiB]."""
    reconnects: int = 0
    """Number of reconnections to the server."""
    trouble: str = ""
    """Description of the present error; empty without an error."""
