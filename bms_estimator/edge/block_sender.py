"""Sender of a pack's raw samples to a fleet's server, by MQTT, in blocks.

``BlockSender`` collects samples in blocks, sends the blocks and receives the workers' confirmations. ``BlockQueue``
stores blocks until a worker has confirmed them.
"""

import asyncio
import contextlib
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import structlog
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.edge.batching import MAX_SAMPLES, Batcher, ReadyBlock
from bms_estimator.edge.block_queue import RETRY_S, BlockQueue
from bms_estimator.edge.block_table import EDGE_TABLES
from bms_estimator.edge.cell_voltages import MAX_CELLS
from bms_estimator.edge.sample_clock import SampleClock
from bms_estimator.model.arrays import NO_CELLS, CellBlock, SampleBlock
from bms_estimator.model.clock import Clock, since_boot
from bms_estimator.model.payloads.health import EdgeHealth
from bms_estimator.mqtt.connection import Connect, Connection, ConnectOptions, DeliveryStats, brokers, check
from bms_estimator.mqtt.queue_sender import DeniedTopics, QueueSender
from bms_estimator.mqtt.reconnect_loop import BrokerConnector, ReconnectLoop
from bms_estimator.process.runtime import FIRST_DELAY_S, end_tasks, finish
from bms_estimator.settings.connections import EdgeSettings
from bms_estimator.store.database import RETRY_S as DISK_RETRY_S, Database

MIB = 1 << 20
PACK = ""
"""Name of the only pack in the queue of an edge."""
MAX_UNWRITTEN_SAMPLES = 500_000
"""Maximum number of samples in memory while the disk cannot be written: 20 MB, or five days at one sample a second."""
MAX_BLOCK_AGE = 1.5
"""Age at which an incomplete block is sent, as a multiple of the block duration."""
FINAL_SEND_TIMEOUT_S = 2.0
"""Time limit for sending the remaining blocks at shutdown [s]."""
MAX_RECONNECT_DELAY_S = 120.0
"""Maximum delay before a reconnect [s]. Delays have a mean of three quarters of it, so that 100,000 edges make 1,100
connection attempts a second. If more attempts arrive than the server can complete before their timeout, all are in vain."""
DISCONNECT_TIMEOUT_S = 1.0
"""Timeout of a disconnect from the server [s]."""

log = structlog.get_logger(__name__)


class BlockSender:
    """Sender of the samples of one pack.

    Args:
        settings: Destination and storage of the blocks.
        pack: Name of the pack.
        folder: Folder of the blocks, in ``<pack>.edge.sqlite``.
        connect: Opens a connection; default: over TCP.
        clock: Clock whose wall time dates samples.
        steady: Monotonic clock that continues during suspend [s].
        max_samples: Maximum number of samples of a block.
        first_delay_s: Delay after a lost connection or a temporary rejection [s].
        retry_s: Delay before a failed disk is retried [s].
        final_send_timeout_s: Time limit for sending the remaining blocks at shutdown [s].

    Attributes:
        delivery: Delivery statistics of the blocks.
        invalid_messages: Number of invalid messages on the workers' topic.

    Raises:
        UserError: A URL or a file of ``settings`` cannot be used.
    """

    def __init__(
        self,
        settings: EdgeSettings,
        pack: str,
        folder: Path,
        *,
        connect: Connect | None = None,
        clock: Clock | None = None,
        steady: Callable[[], float] = since_boot,
        max_samples: int = MAX_SAMPLES,
        first_delay_s: float = FIRST_DELAY_S,
        retry_s: float = DISK_RETRY_S,
        final_send_timeout_s: float = FINAL_SEND_TIMEOUT_S,
    ) -> None:
        self._clock, self._steady, self._final_send_timeout_s = clock or Clock(), steady, final_send_timeout_s
        self._block_s, self._batcher = settings.block_s, Batcher(settings.block_s, max_samples)
        self._sends_cells = settings.cells
        self._database = Database(folder / f"{pack}.edge.sqlite", tables=EDGE_TABLES, sync_s=0.0, retry_s=retry_s)
        self._request_topic, topic = (each(pack).replace(".", "/") for each in (subjects.block_request, subjects.raw))
        max_bytes = settings.store_mib * MIB
        self.queue = BlockQueue(
            self._database, lambda _: topic, max_bytes=max_bytes, max_unwritten=MAX_UNWRITTEN_SAMPLES
        )
        self.delivery, self.invalid_messages = DeliveryStats(), 0
        # blocks are not retained, so that there is nothing to send again after a rejection
        self._denied = DeniedTopics(self.delivery, lambda: None, first_delay_s)
        self._sender = QueueSender(self.queue, self.delivery, self._denied, first_delay_s)
        for warning in check(settings):
            log.warning("secret is readable by other users", reason=warning)
        options = ConnectOptions(f"bms-edge-{pack}-{secrets.token_hex(4)}", None, self._count_invalid)
        self._link = ReconnectLoop(
            brokers(settings),
            options,
            connect or BrokerConnector(settings),
            self._serve,
            self.delivery,
            first_delay_s,
            MAX_RECONNECT_DELAY_S,
        )
        self._sample_clock: SampleClock | None = None
        self._overdue_timer: asyncio.TimerHandle | None = None
        self._sync_requested = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []

    def take(self, samples: SampleBlock, cells_v: CellBlock = NO_CELLS) -> None:
        """Add samples that have just arrived, with times of the source's clock, without waiting.

        Args:
            samples: Samples, shape (n,).
            cells_v: Cell voltages of the samples, shape (n, m) [V]; empty if there are none. They are sent only with the setting
                ``cells``.
        """
        if self._sample_clock is None:
            raise RuntimeError("the sender accepts samples only within its context")
        for task in self._tasks:
            if task.done():
                task.result()  # only an internal error ends a task: raise it
        wall_s = self._clock.wall()
        # a new store may have been created later than the sample clock's time, if a worker had blocks of a later store
        self._sample_clock.advance_to(self.queue.position(PACK).last_s)
        placed = samples.copy()
        placed["time_s"] = self._sample_clock.place(samples["time_s"], wall_s, self._steady())
        is_sent = self._sends_cells and cells_v.shape[1] <= MAX_CELLS
        completed = self._batcher.add(placed, wall_s, cells_v if is_sent else NO_CELLS)
        self._put(completed)
        if completed or self._overdue_timer is None:
            self._watch_open_block()

    def health(self) -> EdgeHealth:
        """Return counters of the blocks."""
        queue = self.queue
        return EdgeHealth(
            blocks_kept=queue.unconfirmed,
            blocks_unsent=queue.waiting,
            blocks_dropped=queue.dropped,
            trouble=self.delivery.trouble,
        )

    async def __aenter__(self) -> Self:
        """Open the queue and start connecting to the server."""
        await self.queue.sync()
        position = self.queue.position(PACK)
        log.info("store of blocks", made_s=position.created_s, next=position.next_number, oldest=position.oldest)
        self._sample_clock = SampleClock(position.last_s)
        self._tasks = [asyncio.create_task(task) for task in (self._link.run(), self._sync_repeatedly())]
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Complete the open block, and send blocks for at most ``final_send_timeout_s``. The next run sends the others."""
        self._end_block()
        self._link.closing.set()
        linking, syncing = self._tasks
        await finish(linking, self._final_send_timeout_s + DISCONNECT_TIMEOUT_S)
        self._database.begin_shutdown()
        await end_tasks(syncing)
        await self.queue.sync()
        await self._database.__aexit__()

    def _watch_open_block(self) -> None:
        """Restart the timer that completes the open block if the source falls silent."""
        if self._overdue_timer is not None:
            self._overdue_timer.cancel()
        due_s = MAX_BLOCK_AGE * self._block_s
        has_samples = len(self._batcher) > 0
        self._overdue_timer = asyncio.get_running_loop().call_later(due_s, self._end_block) if has_samples else None

    def _end_block(self) -> None:
        self._put(self._batcher.cut())
        self._watch_open_block()

    def _put(self, blocks: Sequence[ReadyBlock]) -> None:
        for block in blocks:
            self.queue.put(PACK, block)
            self._sync_requested.set()

    async def _sync_repeatedly(self) -> None:
        """Synchronize memory and disk on request, and retry after a failure."""
        while True:
            self._sync_requested.clear()
            written = await self.queue.sync()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if written else RETRY_S):
                    await self._sync_requested.wait()

    async def _serve(self, connection: Connection) -> None:
        """Send and receive until the connection is lost or the edge closes."""
        self._denied.on_connected()
        try:
            rejected = await connection.subscribe(None, [self._request_topic])
            for topic, reason in rejected.items():
                self._denied.deny(topic, f"not allowed to read it: {reason}")
            async with asyncio.TaskGroup() as tasks:
                transfers = [
                    tasks.create_task(self._receive(connection)),
                    tasks.create_task(self._sender.send(connection)),
                ]
                await self._link.closing.wait()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(self._final_send_timeout_s):
                        await self._sender.wait_until_empty()
                for task in transfers:
                    task.cancel()
        finally:
            self._denied.on_disconnected()

    async def _receive(self, connection: Connection) -> None:
        while True:
            message = await connection.receive()
            try:
                request = subjects.BlockRequest.model_validate_json(message.payload)
            except ValidationError:
                self._count_invalid("unreadable", message.topic)
            else:
                self.queue.on_request(PACK, request)

    def _count_invalid(self, reason: str, topic: str) -> None:
        """Count an invalid message on the workers' topic, and log the first one."""
        if not self.invalid_messages:
            log.warning("invalid message on the workers' topic", reason=reason, topic=topic[:100])
        self.invalid_messages += 1
