"""A sink that stores its snapshots."""

import asyncio
from collections.abc import Callable
from typing import Self

from bms_estimator.model.payloads import Snapshot
from tests.patience import LONG_S


class Collector:
    """Keeps snapshots."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self._news = asyncio.Event()

    def publish(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)
        self._news.set()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def until(self, wanted: Callable[[Snapshot], bool], skip: int = 0) -> Snapshot:
        """The first snapshot that is wanted, of those after the first ``skip``."""
        seen = skip
        async with asyncio.timeout(LONG_S):
            while True:
                self._news.clear()
                for snapshot in self.snapshots[seen:]:
                    if wanted(snapshot):
                        return snapshot
                seen = max(seen, len(self.snapshots))
                await self._news.wait()
