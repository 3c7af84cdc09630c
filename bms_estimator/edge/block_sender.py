"""Sender of a pack's raw samples to a fleet's server, by MQTT, in blocks.

``BlockSender`` collects samples in blocks, sends the blocks and receives the workers' confirmations. ``BlockStore``
stores blocks until a worker has confirmed them. ``SampleClock`` converts the times of a source to a clock that never steps back.
"""

import asyncio
import contextlib
import math
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import numpy as np
import structlog
from numpy.typing import NDArray
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.edge.batching import MAX_SAMPLES, Batcher, ReadyBlock
from bms_estimator.edge.block_store import RETRY_S, BlockStore
from bms_estimator.edge.block_table import EDGE_TABLES
from bms_estimator.edge.cell_voltages import MAX_CELLS
from bms_estimator.model.arrays import NO_CELLS, CellBlock, SampleBlock
from bms_estimator.model.clock import Clock, since_boot
from bms_estimator.model.payloads.health import EdgeHealth
from bms_estimator.mqtt.connection import Connect, Connection, ConnectOptions, DeliveryStats, brokers, check
from bms_estimator.mqtt.queue_sender import DeniedTopics, QueueSender
from bms_estimator.mqtt.reconnect_loop import BrokerConnector, ReconnectLoop
from bms_estimator.process.runtime import FIRST_DELAY_S, end, finish
from bms_estimator.settings.outputs import EdgeSettings
from bms_estimator.store.database import RETRY_S as DISK_RETRY_S
from bms_estimator.store.database import Database

Times = NDArray[np.float64]

DEAD_BAND_S = 1.0
"""Maximum difference between the source's clock and the host's that is not corrected [s], because transport delays vary
too."""
STEP_S = 10.0
"""Minimum difference between the clocks that counts as a step and not as drift [s]. The skipped time becomes a gap."""
SLEW = 0.01
"""Relative rate at which a difference between ``DEAD_BAND_S`` and ``STEP_S`` is corrected. It exceeds the drift of any
resonator."""
WINDOW_S = 600.0
"""Window over which the smallest delay is taken [s]. Samples arrive late and never early, so the smallest delay is the
lag of the source's clock."""
GRID = 2.0**20
"""Clock offsets are multiples of ``1 / GRID`` seconds. With these offsets, a constant sample period stays constant to
the last bit, which compresses best."""


class SampleClock:
    """Clock in seconds since 1970 that never decreases, even if the wall clock does.

    The source's clock gives the intervals between samples. The host's wall clock gives the start, and the host's
    steady clock gives the corrections. The clock follows a wall clock that is set ahead, as on a machine that boots
    without the time; the step becomes a gap. The clock ignores a wall clock that is set back.

    Args:
        last_s: Time of the last sample of an earlier run [s since 1970]; minus infinity without an earlier run.

    Attributes:
        steps: Number of times that a clock was set or the source started.
    """

    def __init__(self, last_s: float = -math.inf) -> None:
        self.steps = 0
        self._last_s = last_s
        self._lead_s = math.nan  # this clock minus the host's steady clock
        self._source_s = math.nan  # the source's clock at the last sample
        self._offset_s = 0.0  # this clock minus the source's
        self._slew_s = 0.0  # remaining correction of the offset, applied at the rate SLEW
        self._min_delay_s, self._window_s = math.inf, 0.0  # smallest delay in the window, and start of the window

    def advance_to(self, time_s: float) -> None:
        """Place the next sample at ``time_s`` if that is later than all placed samples [s since 1970]."""
        if time_s > self._last_s:
            self._last_s, self._lead_s, self._source_s = time_s, math.nan, math.nan

    def place(self, source_s: Times, wall_s: float, steady_s: float) -> Times:
        """Return timestamps of samples that have just arrived [s since 1970].

        Args:
            source_s: Times of the source's clock [s], shape (n,). A non-finite time is replaced by the previous one.
            wall_s: Wall clock now [s since 1970].
            steady_s: Monotonic clock that continues during suspend [s].
        """
        now_s = self._now(wall_s, steady_s)
        source_s = _fill_non_finite(source_s, self._source_s)
        runs = np.split(source_s, np.flatnonzero(np.diff(source_s) < 0.0) + 1)
        return np.concatenate([self._place(run, now_s) for run in runs if run.size] or [source_s])

    def _now(self, wall_s: float, steady_s: float) -> float:
        """Return this clock's present time [s since 1970]."""
        if math.isnan(self._lead_s):
            self._lead_s = max(wall_s, self._last_s) - steady_s
        elif wall_s - steady_s > self._lead_s + STEP_S:
            self._lead_s = wall_s - steady_s
            self._source_s = math.nan
        return steady_s + self._lead_s

    def _place(self, source_s: Times, now_s: float) -> Times:
        """Return timestamps of samples between which the source's clock does not step back."""
        delay_s = now_s - (float(source_s[-1]) + self._offset_s)
        # the first comparison is also false for the first samples, when _source_s is NaN
        if not source_s[0] >= self._source_s or delay_s < -STEP_S:
            self._reset_mapping(source_s, now_s)
        else:
            self._update_drift(delay_s, now_s)
        placed = source_s + self._offset_s
        span_s = float(source_s[-1]) - self._source_s
        if self._slew_s and span_s > 0.0:  # spread the correction evenly over the samples
            shift_s = min(max(self._slew_s, -SLEW * span_s), SLEW * span_s)
            placed += shift_s * (source_s - self._source_s) / span_s
            self._offset_s += shift_s
            self._slew_s -= shift_s
        placed = np.maximum(placed, self._last_s)
        self._source_s, self._last_s = float(source_s[-1]), float(placed[-1])
        return placed

    def _reset_mapping(self, source_s: Times, now_s: float) -> None:
        """Map the last sample to now, unless the first one would then precede an earlier sample."""
        offset_s = max(now_s - float(source_s[-1]), self._last_s - float(source_s[0]))
        self._offset_s, self._slew_s = math.ceil(offset_s * GRID) / GRID, 0.0
        self._source_s = float(source_s[0])
        self._min_delay_s, self._window_s = math.inf, now_s
        self.steps += 1

    def _update_drift(self, delay_s: float, now_s: float) -> None:
        """Schedule a correction if the source's clock runs ahead or falls behind."""
        if delay_s < -DEAD_BAND_S:  # one sample from the future is proof, because transport only delays
            self._slew_s = delay_s
        self._min_delay_s = min(self._min_delay_s, delay_s)
        if now_s - self._window_s < WINDOW_S:
            return
        behind_s, self._min_delay_s, self._window_s = self._min_delay_s, math.inf, now_s
        if behind_s > STEP_S:
            self._offset_s += math.floor(behind_s * GRID) / GRID
            self._slew_s = 0.0
            self.steps += 1
        elif behind_s > DEAD_BAND_S:
            self._slew_s = behind_s


def _fill_non_finite(source_s: Times, previous_s: float) -> Times:
    """Replace each non-finite time by the previous time, or by 0 at the start."""
    if np.isfinite(source_s).all():
        return source_s
    filled = source_s.copy()
    for i in np.flatnonzero(~np.isfinite(source_s)):
        filled[i] = filled[i - 1] if i else (previous_s if math.isfinite(previous_s) else 0.0)
    return filled


MIB = 1 << 20
PACK = ""
"""Name of the only pack in the store of an edge."""
MAX_WAITING_SAMPLES = 500_000
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
        self.store = BlockStore(self._database, lambda _: topic, max_bytes=max_bytes, max_waiting=MAX_WAITING_SAMPLES)
        self.delivery, self.invalid_messages = DeliveryStats(), 0
        # blocks are not retained, so that there is nothing to send again after a rejection
        self._denied = DeniedTopics(self.delivery, lambda: None, first_delay_s)
        self._sender = QueueSender(self.store, self.delivery, self._denied, first_delay_s)
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
        self._sample_clock.advance_to(self.store.position(PACK).last_s)
        placed = samples.copy()
        placed["time_s"] = self._sample_clock.place(samples["time_s"], wall_s, self._steady())
        is_sent = self._sends_cells and cells_v.shape[1] <= MAX_CELLS
        completed = self._batcher.add(placed, wall_s, cells_v if is_sent else NO_CELLS)
        self._put(completed)
        if completed or self._overdue_timer is None:
            self._watch_open_block()

    def health(self) -> EdgeHealth:
        """Return counters of the blocks."""
        store = self.store
        return EdgeHealth(
            blocks_kept=store.unconfirmed,
            blocks_unsent=store.waiting,
            blocks_dropped=store.dropped,
            trouble=self.delivery.trouble,
        )

    async def __aenter__(self) -> Self:
        """Open the store and start connecting to the server."""
        await self.store.sync()
        position = self.store.position(PACK)
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
        await end(syncing)
        await self.store.sync()
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
            self.store.put(PACK, block)
            self._sync_requested.set()

    async def _sync_repeatedly(self) -> None:
        """Synchronize memory and disk on request, and retry after a failure."""
        while True:
            self._sync_requested.clear()
            written = await self.store.sync()
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
                self.store.on_request(PACK, request)

    def _count_invalid(self, reason: str, topic: str) -> None:
        """Count an invalid message on the workers' topic, and log the first one."""
        if not self.invalid_messages:
            log.warning("invalid message on the workers' topic", reason=reason, topic=topic[:100])
        self.invalid_messages += 1
