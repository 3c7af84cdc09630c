"""Monitor of the availability topics of the service and of its pack's sensor.

The monitor detects and corrects messages that other clients publish on these topics.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence

import structlog

from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.mqtt.denied_topics import DeniedTopics
from bms_estimator.mqtt.message import Message

CORRECTION_S = 5.0
"""Minimum interval between two corrections of an availability that another client wrote [s]."""
BURST_S = 60.0
"""Maximum interval between two corrections of one burst [s]. One line is logged for each burst."""
ECHO_S = 10.0
"""Time after which a broker that has not returned ``online`` counts as denying the topic [s]."""

log = structlog.get_logger(__name__)


class AvailabilityMonitor:
    """Compares the availability messages that the broker returns with those that the service has published.

    Args:
        correct_messages: Returns the correct messages. The first message is the availability of the service itself.
        delivery: Statistics in which corrections are counted.
        denied: Denied topics, to which a missing echo is reported.
        wake: Called when ``correct`` is due.
        echo_s: Time within which a broker must return ``online`` [s].
    """

    def __init__(
        self,
        correct_messages: Callable[[], Sequence[Message]],
        delivery: DeliveryStats,
        denied: DeniedTopics,
        wake: Callable[[], object],
        echo_s: float = ECHO_S,
    ) -> None:
        self._correct_messages, self._delivery, self._denied = correct_messages, delivery, denied
        self._wake, self._echo_s = wake, echo_s
        self._echoed = asyncio.Event()
        self._is_wrong = False  # another client has overwritten an availability
        self._corrected_s = -math.inf

    def begin(self) -> None:
        """Reset for a new connection, on which both availabilities are published again."""
        self._echoed.clear()
        self._is_wrong = False

    def record_published(self) -> None:
        """Record that all messages, including the availabilities, were just published."""
        self._is_wrong = False

    def on_message(self, topic: str, payload: bytes) -> None:
        """Handle a received availability: our own echo, or another client's."""
        correct = {message.topic: message.payload for message in self._correct_messages()}
        # the sensor's availability has no correct value before the first snapshot, and then cannot be wrong
        if correct.get(topic, payload) == payload:
            self._echoed.set()
        elif not self._is_wrong:
            self._is_wrong = True
            loop = asyncio.get_running_loop()
            loop.call_at(max(self._corrected_s + CORRECTION_S, loop.time()), self._wake)

    async def correct(self, publish: Callable[[Sequence[Message]], Awaitable[None]]) -> None:
        """Publish the correct availabilities if one is wrong and ``CORRECTION_S`` has passed.

        The correction is counted only after the broker's acknowledgment. A broker that shuts down publishes the will,
        which looks like another client's message, and acknowledges nothing.
        """
        now_s = asyncio.get_running_loop().time()
        since_s = now_s - self._corrected_s
        if not self._is_wrong or since_s < CORRECTION_S:
            return
        self._is_wrong, self._corrected_s = False, now_s
        await publish(self._correct_messages())
        self._delivery.corrections += 1
        if since_s > BURST_S:
            log.warning(
                "another client wrote an availability of this pack; corrected", so_far=self._delivery.corrections
            )

    async def expect_echo(self) -> None:
        """Detect a broker that denies the topic silently, as Mosquitto does with topics that may not be read."""
        topic = self._correct_messages()[0].topic
        try:
            async with asyncio.timeout(self._echo_s):
                await self._echoed.wait()
        except TimeoutError:
            if topic in self._delivery.refused_topics:
                return
            self._denied.deny(topic, "it is not returned: not allowed to read it, or the broker is slow")
            await self._echoed.wait()
            self._denied.allow(topic)
