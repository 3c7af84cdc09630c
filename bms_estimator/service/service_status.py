"""State of the service around a pack, for the topic ``health``."""

from collections.abc import Callable
from dataclasses import dataclass, field

from bms_estimator.model.payloads.health import EdgeHealth, HookHealth, RecordingHealth
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.sources.source import SourceHealth
from bms_estimator.telemetry.charge_energy import ChargeEnergy
from bms_estimator.telemetry.health import NO_FIT, FitTimes


@dataclass
class ServiceStatus:
    """Reports of the parts of the service. Each part writes its own fields."""

    delivery: DeliveryStats = field(default_factory=DeliveryStats)
    """Counters of sent messages and received requests."""
    source_health: Callable[[], SourceHealth] | None = None
    """Returns the health of the source; None: not reported."""
    recording: Callable[[], RecordingHealth | None] = lambda: None
    """Returns the state of a recording; None where nothing is recorded."""
    edge: Callable[[], EdgeHealth | None] = lambda: None
    """Returns the state of the fleet edge; None without one."""
    hooks: Callable[[], HookHealth | None] = lambda: None
    """Returns successes and failures of alarm hooks; None without hooks."""
    fit_times: Callable[[], FitTimes] = lambda: NO_FIT
    """Returns end and duration of the last fit."""
    restarts: int = 0
    """Number of starts that found files of an earlier run."""
    checkpoint: str = "off"
    """Outcome of the last restore or save of a checkpoint."""
    disk_free_mib: float | None = None
    """Free space in the state folder [MiB]."""
    log_lines_lost: int = 0
    """Number of log lines dropped since start."""
    saved_flow: ChargeEnergy | None = None
    """Saved charge and energy; None if they are not saved."""
