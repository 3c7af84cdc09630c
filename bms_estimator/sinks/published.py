"""What devices published last, by topic: from messages to values. Pure: no connection, no clock.

Whoever may publish may put anything there, so all that is kept is bounded, and a payload of any kind has its place.
"""

import json
import math
import re
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from bms_estimator.model.settings import DEVICE_NAME

MOST_DEVICES = 64
"""More are not looked at."""
MOST_TOPICS = 64
"""Of one device; more are not looked at."""
MOST_KEPT_BYTES = 16 * 1024 * 1024
"""Of all payloads together; what would go beyond is not looked at."""
ASKED = ("request", "response")
"""First part of topics that do not say how a device is."""


class Heard(NamedTuple):
    """A message of a device."""

    device: str
    topic: str
    """Below the device's, such as ``state`` or ``alarm/soc_low``."""
    payload: Any
    """Parsed JSON; text where it is none; None: the topic was emptied."""


@dataclass
class Device:
    """What one device published last."""

    topics: dict[str, Any] = field(default_factory=dict)
    """Payloads by topic, parsed JSON or text."""
    heard_s: dict[str, float] = field(default_factory=dict)
    """By topic when that came, seconds since 1970."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Of the payloads [bytes]."""


class Published:
    """What each device below a base topic published last.

    Args:
        base_topic: First part of all topics.
    """

    def __init__(self, base_topic: str) -> None:
        self._root = f"{base_topic}/"
        self.devices: dict[str, Device] = {}
        """By name, in the order in which they were heard first."""
        self._bytes = 0

    def take(self, topic: str, payload: bytes, now_s: float) -> Heard | None:
        """Keep a message.

        Args:
            topic: In full.
            payload: As it came; empty: the topic holds nothing any more.
            now_s: When it came, seconds since 1970.

        Returns:
            What was heard; None where it is nothing of a device, or more than is kept.
        """
        name, _, rest = topic.removeprefix(self._root).partition("/")
        if not topic.startswith(self._root) or not rest or rest.split("/")[0] in ASKED:
            return None
        if not re.fullmatch(DEVICE_NAME, name):
            return None
        if not payload:
            return self._forget(name, rest)
        return self._keep(name, rest, payload, now_s)

    def _keep(self, name: str, topic: str, payload: bytes, now_s: float) -> Heard | None:
        device = self.devices.get(name) or Device()
        grown = len(payload) - device.sizes.get(topic, 0)
        if name not in self.devices and len(self.devices) >= MOST_DEVICES:
            return None
        if topic not in device.topics and len(device.topics) >= MOST_TOPICS:
            return None
        if self._bytes + grown > MOST_KEPT_BYTES:
            return None
        self._bytes += grown
        value = parsed(payload)
        device.topics[topic], device.heard_s[topic], device.sizes[topic] = value, now_s, len(payload)
        self.devices[name] = device
        return Heard(name, topic, value)

    def _forget(self, name: str, topic: str) -> Heard | None:
        device = self.devices.get(name)
        if device is None or topic not in device.topics:
            return None
        del device.topics[topic], device.heard_s[topic]
        self._bytes -= device.sizes.pop(topic)
        if not device.topics:
            del self.devices[name]
        return Heard(name, topic, None)


def parsed(payload: bytes) -> Any:
    """JSON as values, all numbers finite; anything else as text."""
    try:
        return json.loads(payload, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError):
        return payload.decode(errors="replace")


def _finite(token: str) -> float:
    """A number of a payload.

    Raises:
        ValueError: It is NaN or infinite, which JSON does not know.
    """
    number = float(token)
    if not math.isfinite(number):
        raise ValueError(token)
    return number
