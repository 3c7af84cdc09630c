"""State of a terminal view, and a line for each received message. Pure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from bms_estimator.model.clock import iso_utc
from bms_estimator.sinks.mqtt.messages import AVAILABILITY, SENSOR_AVAILABILITY
from bms_estimator.sinks.terminal.json_fields import JsonFields

SILENT_S = 10.0
"""Interval of a service's health messages; a service that is silent for longer counts as gone, although it has not
reported so [s]."""
ALARM = "alarm/"
"""Topics of alarms begin so."""


class BrokerOutage(NamedTuple):
    """Outage of the broker."""

    since_s: float
    """Seconds since 1970."""
    why: str | None


@dataclass(frozen=True)
class PackView:
    """Last publications of one pack."""

    device: str = ""
    """Name of the device; empty without one."""
    topics: Mapping[str, object] = field(default_factory=dict)
    """Payloads by topic below the device's."""
    heard_s: float = 0.0
    """Time of the last message, seconds since 1970."""
    now_s: float = 0.0
    """Now."""
    lost: BrokerOutage | None = None

    @cached_property
    def state(self) -> JsonFields:
        """Topic ``state``."""
        return JsonFields(self.topics.get("state"))

    @cached_property
    def health(self) -> JsonFields:
        """Topic ``health``."""
        return JsonFields(self.topics.get("health"))

    @cached_property
    def info(self) -> JsonFields:
        """Topic ``info``."""
        return JsonFields(self.topics.get("info"))

    @cached_property
    def parameters(self) -> JsonFields:
        """Topic ``parameters``."""
        return JsonFields(self.topics.get("parameters"))

    @property
    def has_no_charge(self) -> bool:
        """True for a fuel cell."""
        return self.info.is_null("capacity_ah")

    @cached_property
    def alarms(self) -> list[JsonFields]:
        """Return raised alarms and, while samples arrive, those that cannot be monitored."""
        told = [JsonFields(payload) for topic, payload in self.topics.items() if topic.startswith(ALARM)]
        online = JsonFields(self.topics.get("health")).flag("sensor_online")
        return [alarm for alarm in told if alarm.flag("active") or (online and alarm.text("unwatched_reason"))]

    @cached_property
    def stale(self) -> str:
        """Why the values are not of now, and since when; empty where they are."""
        if self.lost is not None:
            return f"no broker since {_clock(self.lost.since_s)}" + (f": {self.lost.why}" if self.lost.why else "")
        if not self.device:
            return ""
        if self.topics.get(AVAILABILITY) == "offline":
            return f"service offline{_since(self.health.text('publish_time'))}"
        if self.now_s - self.heard_s > SILENT_S:
            return f"silent since {_clock(self.heard_s)}"
        if self.topics.get(SENSOR_AVAILABILITY) == "offline":
            return f"stale{_since(self.state.text('time'))}"
        return ""


@dataclass(frozen=True)
class ScreenState(PackView):
    """All that is shown at one moment."""

    packs: Sequence[PackView] = ()
    """All there are, this one too."""
    voltage_v: Sequence[float] = ()
    """Voltages of the last publications, oldest first."""
    current_a: Sequence[float] = ()
    """Currents of the same."""
    log: Sequence[str] = ()
    """Log lines, the last ones are shown; ANSI colours allowed."""
    hint: str = ""
    """The last line."""
    true_soc: float | None = None
    """SOC 0..1 of a simulated pack at the last sample."""


def _clock(epoch_s: float) -> str:
    return f"{iso_utc(epoch_s)[11:19]}Z"


def _since(iso: str) -> str:
    """Return the time as text, if known."""
    return f" since {iso[11:19]}Z" if iso else ""
