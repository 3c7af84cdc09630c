"""Queue of packs with deferred messages. The messages stay in the stream until their pack is served."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

MAX_DEFERRED_PACKS = 8192
"""Maximum number of packs of a partition with deferred messages, because a server without tenants accepts any name."""


class Span(NamedTuple):
    """Range of the deferred messages of one pack."""

    first: int
    """Stream sequence number of the first deferred message."""
    last: int
    """Stream sequence number of the last deferred message."""


class Deferred:
    """Queue of the packs with deferred messages, in the order in which they are served.

    Args:
        spans: Span of each pack.

    Attributes:
        is_saved: True if the last checkpoint includes all processed deferred messages.
    """

    def __init__(self, spans: Mapping[str, Span] | None = None) -> None:
        self._spans = dict(spans or {})
        self.is_saved = True

    def __contains__(self, pack: str) -> bool:
        return pack in self._spans

    def __len__(self) -> int:
        return len(self._spans)

    def __iter__(self) -> Iterator[str]:
        return iter(self._spans)

    def spans(self) -> dict[str, Span]:
        """Return a copy of all spans."""
        return dict(self._spans)

    def add(self, pack: str, sequence: int) -> None:
        """Defer a message of a pack."""
        before = self._spans.get(pack)
        self._spans[pack] = Span(before.first if before else sequence, sequence)

    def next(self, is_due: Callable[[str], bool]) -> tuple[str, Span] | None:
        """Return the next due pack and its span, and move the pack to the end of the queue; None if no pack is due."""
        pack = next(filter(is_due, self._spans), None)
        if pack is None:
            return None
        span = self._spans[pack] = self._spans.pop(pack)
        return pack, span

    def advance(self, pack: str, sequence: int) -> None:
        """Record that a pack's messages up to ``sequence`` were processed or have left the stream."""
        span = self._spans.get(pack)
        if span is None:  # cleared while the message was read
            return
        if sequence < span.last:
            self._spans[pack] = span._replace(first=max(span.first, sequence + 1))
        else:
            del self._spans[pack]
        self.is_saved = False

    def clear(self) -> None:
        """Remove all packs, because the stream was recreated."""
        self._spans.clear()
        self.is_saved = False
