"""State of the terminal view: last publications of the pack, and the log. No I/O.

Other versions or publishers may send any value. ``JsonFields`` returns only values of the requested type.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bms_estimator.model.clock import iso_utc
from bms_estimator.sinks.mqtt.messages import SENSOR_AVAILABILITY
from bms_estimator.telemetry.state import clock_duration

ALARM_PREFIX = "alarm/"
"""Prefix of alarm topics."""
NOT_KNOWN = "not known"
"""Text in place of an SOC that is too uncertain."""
BAND_STDS = 2.0
"""Half width of the SOC's confidence band [standard deviations]. The band contains the true SOC in 95 % of the cases."""
MAX_ABS_NUMBER = 1e12
"""Maximum absolute value of an accepted number. No quantity of a battery exceeds it, and longer text would fill a screen."""
MAX_TEXT = 400
"""Maximum length of a text [characters]. Longer texts are truncated."""


class JsonFields:
    """Fields of a JSON object. A payload of another type has no fields.

    Args:
        payload: Parsed JSON, or text.
    """

    def __init__(self, payload: object) -> None:
        self._values = payload if isinstance(payload, dict) else {}

    def __bool__(self) -> bool:
        return bool(self._values)

    def number(self, name: str) -> float | None:
        """Return a number; None if missing."""
        value = self._values.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > MAX_ABS_NUMBER:
            return None
        return float(value)

    def number_text(self, name: str, format_spec: str, factor: float = 1.0) -> str:
        """Return a number times ``factor`` as text; ``-`` if missing."""
        value = self.number(name)
        return "-" if value is None else f"{value * factor:{format_spec}}"

    def count(self, name: str) -> int:
        """Return an integer; 0 if missing."""
        return int(self.number(name) or 0)

    def text(self, name: str) -> str:
        """Return a text without terminal control characters; empty if missing."""
        return _printable(self._values.get(name))

    def texts(self, name: str) -> list[str]:
        """Return a list of texts without terminal control characters; empty if missing."""
        values = self._values.get(name)
        return [_printable(value) for value in values if isinstance(value, str)] if isinstance(values, list) else []

    def flag(self, name: str, *, default: bool = False) -> bool:
        """Return a boolean; ``default`` if missing."""
        value = self._values.get(name)
        return value if isinstance(value, bool) else default


class PackView(NamedTuple):
    """Last publications of the pack."""

    device: str
    """Name of the device."""
    topics: Mapping[str, Any]
    """Payloads by topic, relative to the device's topic."""

    def fields(self, topic: str) -> JsonFields:
        """Return the fields of a topic's last payload."""
        return JsonFields(self.topics.get(topic))

    def alarms(self) -> list[JsonFields]:
        """Return raised alarms and, while samples arrive, those that cannot be monitored."""
        online = self.fields("health").flag("sensor_online")
        alarms = [self.fields(topic) for topic in self.topics if topic.startswith(ALARM_PREFIX)]
        return [alarm for alarm in alarms if alarm.flag("active") or (online and alarm.text("unwatched_reason"))]

    def stale_since(self) -> str | None:
        """Return the time of day of the last state, ``12:00:00Z`` or empty, while its values are stale; otherwise None."""
        if self.topics.get(SENSOR_AVAILABILITY) != "offline":
            return None
        time = self.fields("state").text("time")
        return f"{time[11:19]}Z" if time else ""


class ViewState(NamedTuple):
    """Content of the terminal view at one moment."""

    now_s: float
    """Present time, seconds since 1970."""
    pack: PackView | None = None
    """None before the first publication."""
    log: Sequence[str] = ()
    """Log lines, oldest first; ANSI colors are allowed."""
    hint: str = ""
    """Last line of the screen."""
    true_soc: float | None = None
    """True SOC 0..1 of a simulated pack at the last sample."""


def soc_text(state: JsonFields) -> str:
    """Return the SOC of a topic ``state`` with its band, ``89.50 ± 1.20`` [%]; without the band if that is unknown."""
    if not state.flag("soc_known", default=True) and state.number("soc_percent") is not None:
        return NOT_KNOWN
    soc, std = state.number_text("soc_percent", ".2f"), state.number("soc_std")
    return soc if std is None else f"{soc} ± {100.0 * BAND_STDS * std:.2f}"


def cutoff_band_text(state: JsonFields) -> str:
    """Return the 90 % band of the time to the cut-off of a topic ``state``, ``1:20-2:31`` [h]; ``-`` if it is unknown."""
    p05_s, p95_s = state.number("time_to_cutoff_p05_s"), state.number("time_to_cutoff_p95_s")
    return "-" if p05_s is None or p95_s is None else f"{clock_duration(p05_s)}-{clock_duration(p95_s)}"


def clock_text(epoch_s: float) -> str:
    """Return the time of day in UTC, ``12:00:00Z``."""
    return f"{iso_utc(epoch_s)[11:19]}Z"


def _printable(value: object) -> str:
    return "".join(c for c in value[:MAX_TEXT] if c.isprintable()) if isinstance(value, str) else ""
