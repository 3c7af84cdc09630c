"""Topics that the broker denies, permanently or temporarily."""

import asyncio
from collections.abc import Callable

import structlog

from bms_estimator.mqtt.connection import Message, PublishRejection
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.process.tasks import Backoff

log = structlog.get_logger(__name__)


class DeniedTopics:
    """Reports denied topics in log and health. After a temporary rejection, it requests a resend of retained messages.

    Args:
        delivery: Statistics that list the denied topics.
        resend_retained: Function that sends all retained messages again.
        first_delay_s: Delay after the first temporary rejection [s]. The delay doubles with each rejection.
    """

    def __init__(self, delivery: DeliveryStats, resend_retained: Callable[[], object], first_delay_s: float) -> None:
        self._delivery, self._resend_retained, self._backoff = delivery, resend_retained, Backoff(first_delay_s)
        self._logged: set[str] = set()  # each topic is logged once per connection
        self._denied: dict[str, None] = {}  # dicts instead of sets: they keep the order of the rejections
        self._temporarily_denied: dict[str, None] = {}
        self._resend_timer: asyncio.TimerHandle | None = None

    def on_connected(self) -> None:
        """Clear the denied topics at the beginning of a connection."""
        self.on_disconnected()
        for topics in (self._logged, self._denied, self._temporarily_denied):
            topics.clear()
        self._update_stats()
        self._backoff.reset()

    def on_disconnected(self) -> None:
        """Cancel a pending resend at the end of a connection."""
        if self._resend_timer is not None:
            self._resend_timer.cancel()
            self._resend_timer = None

    def deny(self, topic: str, reason: str) -> None:
        """Record that a topic is denied."""
        self._denied[topic] = None
        self._report("broker refuses a topic; see its access list", topic, reason)

    def allow(self, topic: str) -> None:
        """Record that a topic is allowed."""
        self._denied.pop(topic, None)
        self._update_stats()

    def record_result(self, message: Message, rejection: PublishRejection | None) -> None:
        """Record that the broker accepted or rejected a message."""
        if rejection is not None and rejection.is_retryable:
            self._temporarily_denied[message.topic] = None
            self._report("broker temporarily refuses a topic; retrying", message.topic, rejection.reason)
            if message.retain and self._resend_timer is None:
                delay_s = self._backoff.next_s()
                self._resend_timer = asyncio.get_running_loop().call_later(delay_s, self._resend)
            return
        # a denied topic stays denied after an accepted message, because the denial may concern reading
        if message.topic in self._temporarily_denied:
            del self._temporarily_denied[message.topic]
            self._update_stats()
            if not self._temporarily_denied:
                self._backoff.reset()
        if rejection is not None:
            self.deny(message.topic, f"not allowed to write it: {rejection.reason}")

    def _resend(self) -> None:
        self._resend_timer = None
        self._resend_retained()

    def _report(self, event: str, topic: str, reason: str) -> None:
        """Update the statistics, and log each topic once."""
        self._update_stats()
        if topic not in self._logged:
            self._logged.add(topic)
            log.warning(event, topic=topic, reason=reason)

    def _update_stats(self) -> None:
        self._delivery.refused_topics = list(self._denied | self._temporarily_denied)
