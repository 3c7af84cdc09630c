"""The newest text of each key, and who reads it. No connection, no clock of its own.

A reader who is slow finds only the newest of what came meanwhile: what waits for one is at most a text for each key.
"""

import asyncio
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

LINK = "link"
"""Whether what fills it is connected."""


class Newest:
    """What is known: JSON as text in one line, by key."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._readers: set[Reader] = set()

    @property
    def readers(self) -> int:
        """How many read now."""
        return len(self._readers)

    def known(self) -> dict[str, str]:
        """What a new reader finds."""
        return dict(self._texts)

    def say(self, key: str, text: str) -> None:
        """Keep a text, and hand it on where it is another one."""
        if text != self._texts.get(key):
            self._texts[key] = text
            self.hand_on(key, text)

    def say_link(self, trouble: str | None) -> None:
        """Whether what fills this is connected: why not, or None when it is."""
        self.say(LINK, json.dumps({"up": trouble is None, "reason": trouble}))

    def hand_on(self, key: str, text: str) -> None:
        """To all who read now, kept or not."""
        for reader in self._readers:
            reader.put(key, text)

    @contextmanager
    def reading(self) -> Iterator["Reader"]:
        """A reader, who finds all that is known first."""
        reader = Reader(self.known())
        self._readers.add(reader)
        try:
            yield reader
        finally:
            self._readers.discard(reader)

    def close(self) -> None:
        """Let all readers end."""
        for reader in self._readers:
            reader.close()


class Reader:
    """What waits for one who reads.

    Args:
        known: What is there at first.
    """

    def __init__(self, known: Mapping[str, str]) -> None:
        self._waiting = dict(known)
        self._due = asyncio.Event()
        self._due.set()
        self.closed = False

    def put(self, key: str, text: str) -> None:
        """Have the newest wait."""
        self._waiting[key] = text
        self._due.set()

    def close(self) -> None:
        """Nothing more will come."""
        self.closed = True
        self._due.set()

    async def next(self, longest_s: float) -> str:
        """All that waits as one JSON object; empty when nothing came in ``longest_s``, or when it is closed."""
        try:
            async with asyncio.timeout(longest_s):
                await self._due.wait()
        except TimeoutError:
            return ""
        self._due.clear()
        waiting, self._waiting = self._waiting, {}
        parts = ",".join(f"{json.dumps(key)}:{text}" for key, text in waiting.items())
        return f"{{{parts}}}" if parts else ""
