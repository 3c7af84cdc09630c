"""Topics that the broker denies, permanently or temporarily."""

import asyncio
from collections.abc import Callable

import structlog

from bms_estimator.mqtt.connection import PublishRejection
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.mqtt.message import Message
from bms_estimator.process.backoff import Backoff

log = structlog.get_logger(__name__)


class DeniedTopics:
    """Reports denied topics in log and health, and has retained messages sent again after a temporary rejection.

    Args:
        delivery: The topics are named there.
        say_again: Sends all retained messages again.
        first_delay_s: Delay after a temporary rejection; doubles each time [s].
    """

    def __init__(self, delivery: DeliveryStats, say_again: Callable[[], object], first_delay_s: float) -> None:
        self._delivery, self._say_again, self._pauses = delivery, say_again, Backoff(first_delay_s)
        self._said: set[str] = set()  # one line of the log for each topic and connection
        self._denied: dict[str, None] = {}  # in the order in which it was found out
        self._for_now: dict[str, None] = {}
        self._again: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Clear the denied topics for a new connection."""
        self.end()
        for of_the_last in (self._said, self._denied, self._for_now):
            of_the_last.clear()
        self._show()
        self._pauses.reset()

    def end(self) -> None:
        """Cancel pending repeats."""
        if self._again is not None:
            self._again.cancel()
            self._again = None

    def deny(self, topic: str, why: str) -> None:
        """Record that a topic is denied."""
        self._denied[topic] = None
        self._log("broker refuses a topic; see its access list", topic, why)

    def allow(self, topic: str) -> None:
        """Record that a topic is allowed."""
        self._denied.pop(topic, None)
        self._show()

    def record_result(self, message: Message, refusal: PublishRejection | None) -> None:
        """Record that the broker accepted or rejected a message."""
        if refusal is not None and refusal.is_retryable:
            self._for_now[message.topic] = None
            self._log("broker refuses a topic for now; it is tried again", message.topic, refusal.why)
            if message.retain and self._again is None:
                self._again = asyncio.get_running_loop().call_later(self._pauses.next_s(), self._due)
            return
        if message.topic in self._for_now:
            del self._for_now[message.topic]
            self._show()
            if not self._for_now:
                self._pauses.reset()
        if refusal is not None:
            self.deny(message.topic, f"not allowed to write it: {refusal.why}")

    def _due(self) -> None:
        self._again = None
        self._say_again()

    def _log(self, event: str, topic: str, why: str) -> None:
        """Report denied topics in log and health."""
        self._show()
        if topic not in self._said:
            self._said.add(topic)
            log.warning(event, topic=topic, reason=why)

    def _show(self) -> None:
        self._delivery.refused_topics = list(self._denied | self._for_now)
