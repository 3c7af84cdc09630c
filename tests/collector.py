"""Sink for tests, which stores its snapshots."""

import asyncio
from collections.abc import Callable
from typing import Self

from bms_estimator.model.payloads.snapshot import Snapshot
from tests.patience import LONG_S


class Collector:
    """Sink that stores its snapshots."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self._received = asyncio.Event()

    def publish(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)
        self._received.set()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def until(self, accepts: Callable[[Snapshot], bool], skip: int = 0) -> Snapshot:
        """Wait for a snapshot that ``accepts`` accepts, and return it. The first ``skip`` snapshots are ignored."""
        checked = skip
        async with asyncio.timeout(LONG_S):
            while True:
                self._received.clear()
                for snapshot in self.snapshots[checked:]:
                    if accepts(snapshot):
                        return snapshot
                checked = max(checked, len(self.snapshots))
                await self._received.wait()
