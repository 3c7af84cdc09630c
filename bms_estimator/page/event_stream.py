"""Latest text of each key, and the readers that wait for new texts.

A slow reader receives only the latest text of each key.
"""

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager

MAX_MESSAGE_BYTES = 256 * 1024
"""Maximum size of a message to a reader [bytes]. A client that does not read occupies the memory of one message."""
LINK = "link"
"""Key of the connection state."""


class LatestValues:
    """Latest values as JSON text in one line, by key."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._readers: set[Reader] = set()

    @property
    def readers(self) -> int:
        """Number of present readers."""
        return len(self._readers)

    def keys(self) -> list[str]:
        """Return the keys whose texts a new reader receives."""
        return list(self._texts)

    def text(self, key: str) -> str | None:
        """Return the latest text of a key; None: there is nothing to send."""
        return self._texts.get(key)

    def set_value(self, key: str, text: str) -> None:
        """Store a text; send it to all readers if it differs from the stored one."""
        if text != self._texts.get(key):
            self._texts[key] = text
            self.broadcast(key)

    def set_link_state(self, trouble: str | None) -> None:
        """Set the state of the connection behind the values: the error, or None if connected."""
        self.set_value(LINK, json.dumps({"up": trouble is None, "reason": trouble}))

    def broadcast(self, key: str) -> None:
        """Queue the latest text of a key for all readers."""
        for reader in self._readers:
            reader.put(key)

    @contextmanager
    def reading(self) -> Iterator["Reader"]:
        """Register a new reader within the context. It first receives all present values."""
        reader = Reader(self)
        self._readers.add(reader)
        try:
            yield reader
        finally:
            self._readers.discard(reader)

    def close(self) -> None:
        """End the streams of all readers."""
        for reader in self._readers:
            reader.close()


class Reader:
    """Queue of the keys whose latest text has not been sent to one reader. All readers share the texts.

    Args:
        latest: Source of the keys and texts.
    """

    def __init__(self, latest: LatestValues) -> None:
        self._latest = latest
        self._waiting = dict.fromkeys(latest.keys())
        self._has_news = asyncio.Event()
        self._has_news.set()
        self.closed = False

    def put(self, key: str) -> None:
        """Mark a key whose text has changed."""
        self._waiting[key] = None
        self._has_news.set()

    def close(self) -> None:
        """End the stream."""
        self.closed = True
        self._has_news.set()

    async def next(self, timeout_s: float) -> str:
        """Return waiting texts as one JSON object. Only a single text may be longer than ``MAX_MESSAGE_BYTES``.

        The others wait for the next call. The result is empty after ``timeout_s`` without a change, or when the stream ends.
        """
        try:
            async with asyncio.timeout(timeout_s):
                await self._has_news.wait()
        except TimeoutError:
            return ""
        parts = self._next_texts()
        if not self._waiting:
            self._has_news.clear()
        return f"{{{','.join(parts)}}}" if parts else ""

    def _next_texts(self) -> list[str]:
        """Remove the first waiting keys; return them with their texts, as members of a JSON object."""
        parts, size = list[str](), 0
        while self._waiting:
            key = next(iter(self._waiting))
            text = self._latest.text(key)
            if text is not None:
                size += len(key) + len(text)
                if parts and size > MAX_MESSAGE_BYTES:
                    break
                parts.append(f"{json.dumps(key)}:{text}")
            del self._waiting[key]
        return parts
