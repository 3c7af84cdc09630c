"""Runner of the messages of one partition.

A worker processes one message at a time. The processor time is charged to the pack. In a guarded replay, a block that kills workers
is found and skipped (``takeover``).
"""

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import structlog

from bms_estimator.edge import subjects
from bms_estimator.edge.block import peek_header
from bms_estimator.fleet.nats.dead_letters import DeadLetter
from bms_estimator.fleet.worker.block_result import INTERNAL_ERROR, BlockResult, ResultPublisher
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.partition_reader import RawMessage, is_block
from bms_estimator.fleet.worker.takeover import ReplayGuard

MAX_CPU_FRACTION = 0.1
"""Fraction of a core that a pack may use continuously. A source at 1,000 Hz needs 0.005."""
BURST_S = 0.2
"""Processor time that a pack may use in a burst after a pause [s], enough for 500 minute blocks at 1 Hz."""
MAX_CHARGE_S = 0.1
"""Maximum processor time that is charged for one block [s], the cost of 20,000 samples. The first block may take longer,
because it compiles kernels."""
MAX_LEVELS = 10_000
"""Number of stored bucket levels above which levels of 0 are removed: those packs are idle."""


@dataclass
class Totals:
    """Totals of a worker since its start, over its present and former partitions.

    Attributes:
        blocks, samples: Number of processed blocks and samples.
        faults: Number of blocks skipped because of an internal error.
        dead_letters: Number of dead letters.
        estimation_s: Processor time of the estimation [s].
        lag_s: Largest lag since it was last reset to None [s].
        events: Events in the former partitions by name.
    """

    blocks: int = 0
    samples: int = 0
    faults: int = 0
    dead_letters: int = 0
    estimation_s: float = 0.0
    lag_s: float | None = None
    events: Counter[str] = field(default_factory=Counter)


class CpuBudget:
    """Processor-time budget: a leaky bucket for each pack.

    Args:
        clock: Monotonic clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        # level of each pack's bucket [s], and the time at which the level was computed [s]
        self._levels: dict[str, tuple[float, float]] = {}

    def is_exhausted(self, pack: str) -> bool:
        """Return True if a pack has used up its budget."""
        return self._level_s(pack) > BURST_S

    def charge(self, pack: str, cpu_s: float) -> None:
        """Count processor time that a pack has used [s]."""
        self._levels[pack] = self._level_s(pack) + min(cpu_s, MAX_CHARGE_S), self._clock()
        if len(self._levels) > MAX_LEVELS:
            self._levels = {name: level for name, level in self._levels.items() if self._level_s(name)}

    def _level_s(self, pack: str) -> float:
        level_s, at_s = self._levels.get(pack, (0.0, 0.0))
        return max(level_s - MAX_CPU_FRACTION * (self._clock() - at_s), 0.0)


log = structlog.get_logger(__name__)


class BlockRunner:
    """Runner of the messages of one partition, which counts blocks and queues summaries and dead letters.

    Args:
        number: Number of the partition.
        partitions: Number of partitions of the stream.
        worker: Name of the worker.
        step_lock: Lock of the worker (``BlockLoop``), held while a block is processed.
        guard: Guard against blocks that kill workers.
        results: Publisher of the results.
        totals: Totals of the worker; updated.
        save: Writes a checkpoint.

    Attributes:
        budget: Processor time of each pack.
    """

    def __init__(
        self,
        number: int,
        partitions: int,
        worker: str,
        step_lock: asyncio.Lock,
        guard: ReplayGuard,
        results: ResultPublisher,
        totals: Totals,
        *,
        save: Callable[[], Awaitable[None]],
    ) -> None:
        self._number, self._partitions, self._worker, self._step_lock = number, partitions, worker, step_lock
        self._guard, self._results, self._totals, self._save = guard, results, totals, save
        self.budget = CpuBudget()

    async def process(self, partition: Partition, message: RawMessage) -> BlockResult:
        """Process a message, or defer it if its pack has exhausted its budget or has deferred messages.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        result = self._reject_or_defer(partition, message)
        if result is None:
            return await self._run_guarded(partition.process, message)
        await asyncio.sleep(0)  # lets the event loop send heartbeats while many messages are deferred
        return result

    def process_unguarded(self, partition: Partition, message: RawMessage) -> BlockResult:
        """Process or defer a message that does not belong to a guarded replay, without a request to the server."""
        return self._reject_or_defer(partition, message) or self._run(partition.process, message)

    async def process_deferred(self, partition: Partition, message: RawMessage) -> BlockResult:
        """Process the next deferred message of a pack.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        return await self._run_guarded(partition.process_deferred, message)

    def _reject_or_defer(self, partition: Partition, message: RawMessage) -> BlockResult | None:
        """Reject or defer a message, or return None if its pack is within its budget and has no deferred messages."""
        pack = message.pack
        if subjects.partition_of(pack, self._partitions) != self._number:
            return partition.reject_misplaced(pack, message.sequence)
        if pack in partition.deferred or self.budget.is_exhausted(pack):
            return partition.defer(pack, message.sequence)
        return None

    async def _run_guarded(self, process: Callable[..., BlockResult], message: RawMessage) -> BlockResult:
        """Process a message while no other block is processed. ``_run`` describes the arguments."""
        async with self._step_lock:
            await asyncio.sleep(0)  # lets the event loop send heartbeats between two blocks
            is_lethal = await self._guard.begin_block(message.sequence)
            result = self._run(process, message, is_lethal=is_lethal)
            await self._guard.end_block(message.sequence)
        if is_lethal:
            await self._save()  # the next owner must not process the block again
        return result

    def _run(self, process: Callable[..., BlockResult], message: RawMessage, *, is_lethal: bool = False) -> BlockResult:
        """Process a message, and charge the processor time to its pack.

        Args:
            process: ``Partition.process`` or ``Partition.process_deferred``.
            message: The message.
            is_lethal: True if the block has killed workers.
        """
        begin_s = time.thread_time()
        pack, data, sequence, _ = message
        try:
            result = process(*message, is_lethal=is_lethal)
        except Exception:  # otherwise the message would end each worker that takes over the partition
            log.exception("a block is skipped", partition=self._number, pack=pack, sequence=sequence)
            result = BlockResult(pack, failed=1, dead_reason=INTERNAL_ERROR)
        cpu_s = time.thread_time() - begin_s
        self.budget.charge(pack, cpu_s)
        self._totals.estimation_s += cpu_s
        self._totals.faults += result.failed
        self._results.queue(result)
        if result.dead_reason:
            self._totals.dead_letters += 1
            self._results.queue_dead_letter(DeadLetter(pack, sequence, result.dead_reason, self._worker, data))
        if not result.is_deferred and is_block(data):
            self._count_block(data)
        return result

    def _count_block(self, data: bytes) -> None:
        """Count a block and its samples, and update the lag."""
        samples, arrival_s = peek_header(data)
        self._totals.blocks += 1
        self._totals.samples += samples
        self._totals.lag_s = max(self._totals.lag_s or 0.0, time.time() - arrival_s)
