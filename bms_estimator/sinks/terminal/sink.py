"""The live view of the pack that this process serves, without a broker."""

from collections.abc import Callable, Iterable
from typing import Self

from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads import Snapshot
from bms_estimator.mqtt.message import Message
from bms_estimator.mqtt.topic_cache import TopicCache
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.terminal.live_view import LiveView

BASE_TOPIC = "bms"
"""Base topic of the messages, which are not sent."""


class TerminalSink:
    """Shows snapshots as a subscriber would see them. ``publish`` returns at once, however long stdout is blocked.

    Args:
        log: Log lines to show below, the last ones.
        hint: A line that stays at the foot of the screen.
        true_soc: Returns the pack's true SOC 0..1 at the last sample, in a simulation.
        clock: The clocks.
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
        self._published = TopicCache(BASE_TOPIC)
        self._view = LiveView(self._published.devices, log=log, hint=hint, true_soc=true_soc, wall=self._clock.wall)
        self._messages: MessageBuilder | None = None
        self._before: Snapshot | None = None
        self._sent = PublishedState()

    async def __aenter__(self) -> Self:
        """Take the screen."""
        await self._view.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Give the screen back."""
        await self._view.__aexit__(None, None, None)

    def publish(self, snapshot: Snapshot) -> None:
        """Show a snapshot.

        Raises:
            OSError: Standard output could not be written.
        """
        for message in self._messages_of(snapshot):
            heard = self._published.take(message.topic, message.payload, self._clock.wall())
            if heard is not None:
                self._view.on_message(heard)
        self._view.show()

    def _messages_of(self, snapshot: Snapshot) -> list[Message]:
        """Return the messages that a broker would get."""
        greeting: list[Message] = []
        if self._messages is None:
            self._messages = MessageBuilder(BASE_TOPIC, snapshot.info.device)
            greeting = self._messages.birth_messages()
        kept = self._messages.must_deliver(self._before, snapshot)
        due, self._sent = self._messages.live_messages(self._sent, snapshot, self._clock.monotonic())
        self._before = snapshot
        return [*greeting, *kept, *due]
