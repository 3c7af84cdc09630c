"""Queue on disk with the blocks of one pack or many. A block stays until a worker has confirmed it, and is sent again on request.

A *store* is a series of numbered blocks of one pack. Blocks and requests identify it by its creation time. A new store begins if
the disk has lost blocks that a worker already has.

The event loop never waits for the disk. Blocks wait in memory without a number until they are written. A block is sent
only after its number is on disk, since a restart could otherwise use the number again.
"""

import asyncio
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import structlog

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import MAX_NUMBER, with_oldest
from bms_estimator.edge.block_table import (
    MAX_CREATED_S,
    NS_PER_S,
    BlockRange,
    PackPosition,
    Page,
    Progress,
    read_pages,
    read_state,
    write_changes,
)
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.mqtt.connection import Message, QueuedMessage
from bms_estimator.store.database import Database, StoreError

RETRY_S = 1.0
"""Retry interval of a failed disk operation [s]. It may be short, because ``Database`` does not access a failed disk
before its own retry delay has passed."""
RESEND_S = 30.0
"""Minimum interval between two resends of a block [s], because a lagging worker repeats its request before the block
can arrive."""

log = structlog.get_logger(__name__)


@dataclass
class _Pack:
    """Position of a pack on disk, and progress of sending its blocks."""

    position: PackPosition
    cursor: int = 1
    """Number of the next block to send."""
    last_resend: tuple[int, float] = (0, -math.inf)
    """Block number and time of the last resend."""


class BlockQueue:
    """Queue of blocks, in order for each pack, until a worker has confirmed them; implements ``mqtt.queue_sender.MessageQueue``.

    Args:
        database: Database with ``EDGE_TABLES`` or ``INGEST_TABLES``, synced at each transaction; its owner opens and closes it.
        topic: Function that returns the topic of a pack's blocks.
        max_blocks: Maximum number of blocks of a pack on disk. Beyond it, the pack's oldest block is dropped.
        max_bytes: Maximum size of the database [bytes]. Beyond it, the oldest block is dropped.
        max_unwritten: Maximum number of samples in memory after the disk has failed. Beyond it, the oldest block is dropped.
        resend_s: Minimum interval between two resends of one block [s].

    Attributes:
        connected: True if a broker is connected, as set by the sender.
        dropped: Number of blocks lost since start: disk or memory full, disk damaged, or a new store begun.
        resends: Number of accepted requests to send blocks again.
        progress: Progress in the stream ``TELEMETRY``, as stored.
    """

    def __init__(
        self,
        database: Database,
        topic: Callable[[str], str],
        *,
        max_blocks: int = MAX_NUMBER,
        max_bytes: float = math.inf,
        max_unwritten: float = math.inf,
        resend_s: float = RESEND_S,
    ) -> None:
        self._database, self._topic = database, topic
        self._max_blocks, self._max_bytes, self._max_unwritten = max_blocks, max_bytes, max_unwritten
        self._resend_s = resend_s
        self._packs = dict[str, _Pack]()
        self._unwritten = list[tuple[str, ReadyBlock]]()  # blocks that are not on disk yet
        self._unsent = dict[str, None]()  # packs with blocks on disk from their cursor on, in the order of sending
        self._single_resends = list[BlockRange]()  # of one block each
        self._in_flight = dict[int, tuple[str, int]]()  # pack and number of sent blocks, by number of the message
        self._messages = itertools.count(1)
        self._changed, self._removed = set[str](), set[str]()  # packs whose row on disk differs from memory
        self._open_count = 0  # ``Database.open_count`` at the last transaction
        self._loss_logged = False  # since the last confirmation
        self._block_ready = asyncio.Event()
        self.connected = False
        self.dropped = self.resends = 0
        self.progress = Progress()

    @property
    def packs(self) -> list[str]:
        """Names of the packs with a position."""
        return list(self._packs)

    def __contains__(self, pack: object) -> bool:
        return pack in self._packs

    def position(self, pack: str) -> PackPosition:
        """Return the position of a pack on disk; the default for an unknown pack."""
        return self._packs[pack].position if pack in self._packs else PackPosition()

    def unconfirmed_of(self, pack: str) -> int:
        """Return the number of blocks of a pack that no worker has confirmed."""
        position = self.position(pack)
        return position.next_number - position.oldest + sum(each == pack for each, _ in self._unwritten)

    @property
    def unconfirmed(self) -> int:
        """Number of blocks that no worker has confirmed."""
        positions = (pack.position for pack in self._packs.values())
        return len(self._unwritten) + sum(position.next_number - position.oldest for position in positions)

    @property
    def waiting(self) -> int:
        """Number of blocks that the broker has not acknowledged."""
        unsent = (self._packs[pack] for pack in self._unsent)
        ready = sum(pack.position.next_number - pack.cursor for pack in unsent)
        return len(self._unwritten) + ready + len(self._in_flight)

    def add_pack(self, pack: str, position: PackPosition) -> None:
        """Add a pack, or replace its position, in memory only."""
        self._forget_sent(pack)
        self._packs[pack] = _Pack(position, max(position.sent + 1, position.oldest))
        self._update_unsent(pack)

    def remove(self, pack: str) -> None:
        """Remove a pack and its blocks."""
        self._forget_sent(pack)
        self._packs.pop(pack, None)
        self._unwritten = [each for each in self._unwritten if each[0] != pack]
        self._changed.discard(pack)
        self._removed.add(pack)

    def put(self, pack: str, ready: ReadyBlock) -> None:
        """Append a block, with times in seconds since 1970, without waiting for the disk. ``sync`` writes it."""
        self._unwritten.append((pack, ready))

    def on_request(self, pack: str, request: BlockRequest) -> None:
        """Handle a worker's request for the next block of a pack. A request for an unknown pack is ignored."""
        if pack not in self._packs:
            return
        entry, position = self._packs[pack], self.position(pack)
        created_ns = position.created_s * NS_PER_S
        if request.store > created_ns or (request.store == created_ns and request.number > position.next_number):
            self._begin_store(pack, request.store)
        elif request.store == created_ns:
            entry.position = position = position._replace(oldest=max(position.oldest, request.number))
            entry.cursor = max(entry.cursor, position.oldest)
            self._changed.add(pack)
            self._loss_logged = False  # the server receives blocks
            if request.resend and request.number < entry.cursor:
                self._resend_from(entry, request.number)
            self._update_unsent(pack)

    def resend_one(self, pack: str, number: int) -> None:
        """Send one block again, without those after it, if it was sent and is still stored."""
        position = self.position(pack)
        if position.oldest <= number < self._packs[pack].cursor:
            self._single_resends.append(BlockRange(pack, position.created_s, number, number + 1))
            self._block_ready.set()

    async def take(self, max_count: int) -> list[QueuedMessage]:
        """Wait for a block, then return up to ``max_count`` blocks, consecutive ones of each pack."""
        while True:
            while not (self._unsent or self._single_resends):
                self._block_ready.clear()
                await self._block_ready.wait()
            resends, self._single_resends = self._single_resends[:max_count], self._single_resends[max_count:]
            unsent = ((pack, self._packs[pack]) for pack in itertools.islice(self._unsent, max_count))
            ranges = resends + [
                BlockRange(pack, entry.position.created_s, entry.cursor, entry.position.next_number)
                for pack, entry in unsent
            ]
            read = functools.partial(read_pages, ranges=ranges, max_blocks=max_count)
            try:
                pages = await self._database.call(read)
            except StoreError:
                await asyncio.sleep(RETRY_S)
                continue
            if messages := [message for page in pages for message in self._send(page)]:
                return messages

    def acknowledge(self, number: int, rejection: str = "") -> None:  # noqa: ARG002
        """Record that the broker has acknowledged a block. It stays stored, because the server may still lose it."""
        if sent := self._in_flight.pop(number, None):
            pack, block = sent
            position = self.position(pack)
            self._packs[pack].position = position._replace(sent=max(position.sent, block))
            self._changed.add(pack)

    def rewind(self) -> None:
        """Make ``take`` return all unacknowledged blocks again, in order, after a lost connection."""
        for pack, number in self._in_flight.values():
            entry = self._packs[pack]
            entry.cursor = max(min(entry.cursor, number), entry.position.oldest)
            self._update_unsent(pack)
        self._in_flight.clear()

    async def sync(self, progress: Progress | None = None) -> bool:
        """Write all changes to disk, after the first call has read the state of an earlier run. Return False if the disk failed."""
        unwritten = self._unwritten.copy()
        changed, self._changed = self._changed, set()
        removed, self._removed = self._removed, set()
        try:
            if not self._open_count:
                await self._load()
            changed.update(pack for pack, _ in unwritten)
            if changed or removed or (progress or self.progress) != self.progress:
                await self._write(unwritten, changed, removed, progress or self.progress)
        except BaseException as error:
            self._changed |= changed & self._packs.keys()  # without packs that were removed meanwhile
            self._removed |= removed
            if not isinstance(error, StoreError):
                raise
            while (
                len(self._unwritten) > 1
                and sum(block.samples.size for _, block in self._unwritten) > self._max_unwritten
            ):
                del self._unwritten[0]
                self._count_lost(1, "the disk cannot be written, and memory is full")
            return False
        return True

    async def _load(self) -> None:
        """Read the state of an earlier run."""
        self.progress, positions = await self._database.call(read_state)
        self._open_count = self._database.open_count
        for pack, position in positions.items():
            self.add_pack(pack, position)

    async def _write(
        self, unwritten: Sequence[tuple[str, ReadyBlock]], changed: set[str], removed: set[str], progress: Progress
    ) -> None:
        """Write the unwritten blocks and all changed positions."""
        packs = {pack: self._packs.setdefault(pack, _Pack(PackPosition())) for pack in changed}
        before = {pack: entry.position for pack, entry in packs.items()}
        write = functools.partial(
            write_changes,
            positions=before,
            unwritten=unwritten,
            removed=removed,
            progress=progress,
            max_blocks=self._max_blocks,
            max_bytes=self._max_bytes,
        )
        after = await self._database.call(write)
        # blocks that went into a store that was replaced meanwhile stay in memory, and are written to the new one
        written = {id(block) for pack, block in unwritten if self._packs.get(pack) is packs[pack]}
        self._unwritten = [each for each in self._unwritten if id(each[1]) not in written]
        self.progress = progress
        if self._open_count != self._database.open_count:  # a damaged or deleted file was replaced by an empty one
            self._open_count = self._database.open_count
            self._changed.update(self._packs)
        for pack, position in after.items():
            entry = self._packs.get(pack)
            if entry is packs[pack]:  # else the pack was removed, or a new store was begun meanwhile
                self._count_lost(position.oldest - before[pack].oldest, "the store is full or damaged")
                sent, oldest = max(position.sent, entry.position.sent), max(position.oldest, entry.position.oldest)
                entry.position = position._replace(sent=sent, oldest=oldest)
                entry.cursor = max(entry.cursor, oldest)
                self._update_unsent(pack)

    def _send(self, page: Page) -> Iterator[QueuedMessage]:
        """Yield the messages of a page, unless the pack's cursor or store has changed while the page was read."""
        pack, created_s, first, end = page.range
        entry = self._packs.get(pack)
        if entry is None or entry.position.created_s != created_s:
            return
        if entry.cursor == first:
            entry.cursor = end
            self._unsent.pop(pack, None)  # the other packs are next
            self._update_unsent(pack)
        elif end - first > 1:  # a page of one block may be of ``resend_one``, and lie before the cursor
            return
        if page.is_damaged:
            self._changed.add(pack)  # the next write finds the oldest block that is left
        oldest = max(page.oldest, entry.position.oldest)
        for number, data in page.blocks.items():
            message = next(self._messages)
            self._in_flight[message] = pack, number
            payload = with_oldest(data, min(oldest, number))
            yield QueuedMessage(message, Message(self._topic(pack), payload, 1, retain=False))

    def _resend_from(self, entry: _Pack, number: int) -> None:
        """Send the requested block and all later blocks again, unless that request was granted less than ``resend_s`` ago.

        The requested block is the oldest one, because ``on_request`` has confirmed the blocks before it, unless it was dropped.
        """
        now_s = asyncio.get_running_loop().time()
        last_number, last_s = entry.last_resend
        if number != last_number or now_s - last_s >= self._resend_s:
            entry.last_resend = number, now_s
            entry.cursor = entry.position.oldest
            self.resends += 1

    def _begin_store(self, pack: str, other_ns: int) -> None:
        """Replace the store of a pack by one created later than ``other_ns``, because a worker has later blocks than this disk.

        The disk may have been restored from a backup.
        """
        position, first_s = self.position(pack), math.ceil(other_ns / NS_PER_S) + 1
        # begun by an earlier request; the creation time is set with the first block
        is_begun = not position.created_s and position.last_s >= first_s
        if first_s > MAX_CREATED_S or is_begun:
            return
        log.warning("a worker has later blocks of this pack than this store: a new store is begun", pack=pack)
        self._count_lost(position.next_number - position.oldest, "a new store is begun")
        self.add_pack(pack, PackPosition(last_s=max(position.last_s, first_s)))
        self._removed.add(pack)  # ``write_changes`` deletes the old blocks before it writes the new position
        self._changed.add(pack)

    def _forget_sent(self, pack: str) -> None:
        self._unsent.pop(pack, None)
        self._in_flight = {message: sent for message, sent in self._in_flight.items() if sent[0] != pack}

    def _update_unsent(self, pack: str) -> None:
        """List a pack for sending while it has blocks from its cursor on."""
        entry = self._packs[pack]
        if entry.cursor < entry.position.next_number:
            self._unsent[pack] = None
            self._block_ready.set()
        else:
            self._unsent.pop(pack, None)

    def _count_lost(self, blocks: int, reason: str) -> None:
        if blocks > 0 and not self._loss_logged:
            log.warning("blocks of samples are lost", reason=reason, blocks=blocks)
            self._loss_logged = True
        self.dropped += blocks
