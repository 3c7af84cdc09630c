"""The two availabilities: whether they hold what we wrote there, and putting them right where they do not."""

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
"""Corrections closer than this are one burst, of which one line is logged [s]."""
ECHO_S = 10.0
"""A broker that has not given back ``online`` by then denies it [s]."""

log = structlog.get_logger(__name__)


class AvailabilityMonitor:
    """Receives the own messages back from the broker.

    Args:
        own: What the availabilities must hold now; the service's own first.
        delivery: Corrections are counted there.
        refusals: Reports an ``online`` that does not come back.
        wake: Called when it is time to ``correct``.
        echo_s: Time within which a broker must return ``online`` [s].
    """

    def __init__(
        self,
        own: Callable[[], Sequence[Message]],
        delivery: DeliveryStats,
        refusals: DeniedTopics,
        wake: Callable[[], object],
        echo_s: float = ECHO_S,
    ) -> None:
        self._own, self._delivery, self._refusals = own, delivery, refusals
        self._wake, self._echo_s = wake, echo_s
        self._echoed = asyncio.Event()
        self._forged = False  # another client wrote there
        self._corrected_s = -math.inf

    def begin(self) -> None:
        """Publish both availabilities again over a new connection, because the broker may hold nothing."""
        self._echoed.clear()
        self._forged = False

    def record_published(self) -> None:
        """Note that all messages were just sent."""
        self._forged = False

    def on_message(self, topic: str, payload: bytes) -> None:
        """Handle a received availability: our own echo, or another client's."""
        right = {own.topic: own.payload for own in self._own()}
        if right.get(topic, payload) == payload:
            self._echoed.set()
        elif not self._forged:
            self._forged = True
            loop = asyncio.get_running_loop()
            loop.call_at(max(self._corrected_s + CORRECTION_S, loop.time()), self._wake)

    async def correct(self, publish: Callable[[Sequence[Message]], Awaitable[None]]) -> None:
        """Put the availabilities right, if it is time.

        Counted when the broker has acknowledged it, because a broker that ends publishes the will and acknowledges
        nothing.
        """
        now_s = asyncio.get_running_loop().time()
        since_s = now_s - self._corrected_s
        if not self._forged or since_s < CORRECTION_S:
            return
        self._forged, self._corrected_s = False, now_s
        await publish(self._own())
        self._delivery.corrections += 1
        if since_s > BURST_S:
            log.warning(
                "somebody else wrote an availability of this pack: put right", so_far=self._delivery.corrections
            )

    async def expect_echo(self) -> None:
        """Find out a broker that denies us without a word, as Mosquitto does with what may not be read."""
        topic = self._own()[0].topic
        try:
            async with asyncio.timeout(self._echo_s):
                await self._echoed.wait()
        except TimeoutError:
            if topic in self._delivery.refused_topics:
                return
            self._refusals.deny(topic, "it does not come back: not allowed to read it, or the broker is slow")
            await self._echoed.wait()
            self._refusals.allow(topic)
