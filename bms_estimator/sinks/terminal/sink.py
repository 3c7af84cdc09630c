"""Live view of the pack that this process serves, without a broker."""

from collections.abc import Callable, Iterable
from typing import Self

from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.message import Message
from bms_estimator.mqtt.topic_cache import TopicCache
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.terminal.live_view import LiveView

BASE_TOPIC = "bms"
"""Base topic of the messages, which are not sent."""


class TerminalSink:
    """Sink that shows snapshots as a subscriber would see them. ``publish`` does not wait for a blocked stdout.

    Args:
        log: Log lines, the last of which are shown.
        hint: Last line of the screen.
        true_soc: Returns the pack's true SOC 0..1 at the last sample, in a simulation.
        clock: Wall clock and monotonic clock.
    """

    def __init__(
        self,
        *,
        log: Iterable[str] = (),
        hint: str = "",
        true_soc: Callable[[], float | None] = lambda: None,
        clock: Clock | None = None,
    ) -> None:
        self._clock = clock or Clock()
        self._cache = TopicCache(BASE_TOPIC)
        self._view = LiveView(self._cache.devices, log=log, hint=hint, true_soc=true_soc, wall=self._clock.wall)
        self._builder: MessageBuilder | None = None
        self._previous: Snapshot | None = None
        self._sent = PublishedState()

    async def __aenter__(self) -> Self:
        """Start the view."""
        await self._view.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the view."""
        await self._view.__aexit__(None, None, None)

    def publish(self, snapshot: Snapshot) -> None:
        """Show a snapshot.

        Raises:
            OSError: Standard output could not be written.
        """
        for message in self._messages(snapshot):
            received = self._cache.take(message.topic, message.payload, self._clock.wall())
            if received is not None:
                self._view.on_message(received)
        self._view.show()

    def _messages(self, snapshot: Snapshot) -> list[Message]:
        """Return the messages that a broker would receive."""
        birth: list[Message] = []
        if self._builder is None:
            self._builder = MessageBuilder(BASE_TOPIC, snapshot.info.device)
            birth = self._builder.birth_messages()
        guaranteed_messages = self._builder.guaranteed_messages(self._previous, snapshot)
        live, self._sent = self._builder.live_messages(self._sent, snapshot, self._clock.monotonic())
        self._previous = snapshot
        return [*birth, *guaranteed_messages, *live]
