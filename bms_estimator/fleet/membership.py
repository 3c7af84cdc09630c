"""Which worker tries for which partition: each computes the same from who has been heard of. Pure: the clock is a value.

Rendezvous hashing (Thaler and Ravishankar, "A name-based mapping scheme for rendezvous", 1996): a partition belongs to the
worker with the highest hash of the pair, so that one who joins or leaves moves no partition between two others. The
workers need not agree at each moment: a partition is with whom the server has pinned it to.
"""

from collections.abc import Iterable
from hashlib import blake2b

from bms_estimator.fleet.heartbeat import DEAD_S


def owner(partition: int, workers: Iterable[str]) -> str:
    """Which of some workers, one at least, is to have a partition."""
    return max(workers, key=lambda worker: (blake2b(f"{partition} {worker}".encode(), digest_size=8).digest(), worker))


class Members:
    """The workers that are alive.

    Args:
        me: Always one of them, until it leaves.
    """

    def __init__(self, me: str) -> None:
        self.me = me
        self._heard: dict[str, float] = {}

    def hear(self, worker: str, now_s: float, *, leaving: bool = False) -> bool:
        """Take a heartbeat, at ``now_s`` of a monotonic clock. Whether the worker is new."""
        if leaving:
            self._heard.pop(worker, None)
            return False
        new = worker not in self._heard
        self._heard[worker] = now_s
        return new and worker != self.me

    def forgive(self, now_s: float) -> None:
        """None could be heard until now: their silence says nothing."""
        self._heard = dict.fromkeys(self._heard, now_s)

    def alive(self, now_s: float) -> list[str]:
        """All of them."""
        self._heard = {worker: heard_s for worker, heard_s in self._heard.items() if now_s - heard_s < DEAD_S}
        return sorted({self.me, *self._heard})

    def share(self, partitions: int, now_s: float) -> set[int]:
        """Those of so many partitions that are ours to try for."""
        alive = self.alive(now_s)
        return {number for number in range(partitions) if owner(number, alive) == self.me}
