"""Processing of single messages of one partition: one at a time in the worker, guarded against deaths, and charged to the pack."""

import asyncio
import time
from collections.abc import Awaitable, Callable

import structlog

from bms_estimator.edge.block import peek_header
from bms_estimator.fleet.nats.dead_letters import DeadLetter
from bms_estimator.fleet.packs.table_change import is_change
from bms_estimator.fleet.worker.cpu_budget import CpuBudget
from bms_estimator.fleet.worker.partition import INTERNAL_ERROR, BlockResult
from bms_estimator.fleet.worker.replay_guard import ReplayGuard
from bms_estimator.fleet.worker.result_publisher import ResultPublisher
from bms_estimator.fleet.worker.table_change_sender import TableChangeSender

log = structlog.get_logger(__name__)


class BlockRunner:
    """Runner of the messages of one partition, which counts blocks and queues summaries and dead letters.

    Args:
        number: Number of the partition.
        worker: Name of the worker.
        step_lock: Lock of the worker, held while a block is estimated. The event loop can send requests and heartbeats between
            two blocks.
        guard: Guard of the partition.
        results: Publisher of summaries and dead letters.
        changes: Sender of changes of the table.
        save: Writes a checkpoint.

    Attributes:
        budget: Processor time of each pack.
        blocks, samples: Number of processed blocks and samples.
        faults: Number of blocks skipped because of an internal error.
        dead_letters: Number of dead letters.
        lag_s: Largest lag since it was last reset to None [s].
    """

    def __init__(
        self,
        number: int,
        worker: str,
        step_lock: asyncio.Lock,
        guard: ReplayGuard,
        results: ResultPublisher,
        changes: TableChangeSender,
        save: Callable[[], Awaitable[None]],
    ) -> None:
        self._number, self._worker, self._step_lock = number, worker, step_lock
        self._guard, self._results, self._changes, self._save = guard, results, changes, save
        self.budget = CpuBudget()
        self.blocks = self.samples = self.faults = self.dead_letters = 0
        self.lag_s: float | None = None

    async def run(self, pack: str, data: bytes, sequence: int, take: Callable[..., BlockResult]) -> BlockResult:
        """Process a message while no other block is processed. ``run_unguarded`` describes the arguments.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        async with self._step_lock:
            await asyncio.sleep(0)  # lets the event loop send heartbeats between two blocks
            is_lethal = await self._guard.is_lethal(sequence)
            result = self.run_unguarded(pack, data, sequence, take, is_lethal=is_lethal)
            await self._guard.end_block(sequence)
        if is_lethal:
            await self._save()  # the next owner must not process the block again
        return result

    def run_unguarded(
        self, pack: str, data: bytes, sequence: int, take: Callable[..., BlockResult], *, is_lethal: bool = False
    ) -> BlockResult:
        """Process a message, and charge the processor time to its pack.

        Args:
            pack: Name of the pack.
            data: Bytes of the message.
            sequence: Stream sequence number of the message.
            take: ``Partition.take`` or ``Partition.take_deferred``.
            is_lethal: True if the block has killed workers.
        """
        begin_s = time.thread_time()
        try:
            result = take(pack, data, sequence, is_lethal=is_lethal)
        except Exception:  # an internal error with one pack, which would otherwise end one worker after another
            log.exception("a block is skipped", partition=self._number, pack=pack, sequence=sequence)
            result = BlockResult(pack, failed=1, dead_reason=INTERNAL_ERROR)
        self.budget.charge(pack, time.thread_time() - begin_s)
        self.faults += result.failed
        self._results.queue_summaries(result)
        if result.dead_reason:
            self._add_dead_letter(DeadLetter(pack, sequence, result.dead_reason, self._worker, data))
        if is_change(data):  # the table may have changed again since this change was sent
            self._changes.add(pack)
        return result

    def count_block(self, data: bytes) -> None:
        """Count a block and its samples, and update the lag. Changes of the table are not counted."""
        if is_change(data):
            return
        samples, arrival_s = peek_header(data)
        self.blocks += 1
        self.samples += samples
        self.lag_s = max(self.lag_s or 0.0, time.time() - arrival_s)

    def _add_dead_letter(self, letter: DeadLetter) -> None:
        self.dead_letters += 1
        self._results.queue_dead_letter(letter)
