"""A partition: its packs' states, stepped block by block by the same kernel as everywhere.

What a worker does follows from the stream's order and the table of packs alone: from any checkpoint on, the same blocks
leave the same states to the last bit. No connection, no file; the only clock is that of the publications.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import NamedTuple, Self

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.edge.block import Block, BlockError, decode
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.packs.pack_type import PackType, PackTypes
from bms_estimator.fleet.worker.block_order import BlockOrder, classify_block, edge_reply, mark_taken
from bms_estimator.fleet.worker.block_processor import BlockProcessor
from bms_estimator.fleet.worker.checkpoint_format import (
    CheckpointError,
    PartitionCheckpoint,
    PreviousLayoutState,
    dtype_of,
    read_checkpoint,
)
from bms_estimator.fleet.worker.deferred import MAX_UNKNOWN, Deferred
from bms_estimator.fleet.worker.density import density_fault
from bms_estimator.fleet.worker.pack_state import Fields, WorkRecord
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.settings.pack import Settings

Table = Callable[[str], tuple[Settings, PackModel] | None]
"""The settings of a pack, and the pack as one object; None: it is not known."""

log = structlog.get_logger(__name__)


class BlockResult(NamedTuple):
    """Result of a block.

    Attributes:
        pack: Name of the pack.
        awaits: For its edge.
        state: Topic ``state``.
        parameters: Topic ``parameters``.
        hours: Finished hours: an id that is the same whoever makes the row, and the row.
        failed: Blocks that were skipped because of an internal error.
    """

    pack: str
    awaits: BlockRequest | None = None
    state: bytes | None = None
    parameters: bytes | None = None
    hours: tuple[tuple[str, bytes], ...] = ()
    failed: int = 0


class Partition:
    """The packs of one partition.

    Args:
        number: Number of the partition.
        table: The packs' settings.
        wall: Wall clock of the publications [s since 1970].

    Attributes:
        number: Number of the partition.
        sequence: Sequence of the last message that was taken or deferred; 0: none.
        deferred: Packs whose messages wait in the stream.
    """

    def __init__(self, number: int, table: Table, *, wall: Callable[[], float] = time.time) -> None:
        self.number, self.sequence = number, 0
        self._table = table
        self._counters: Counter[str] = Counter()
        self._packs: dict[str, bytes] = {}
        self._former: dict[str, PreviousLayoutState] = {}
        self._former_deliveries: dict[str, np.void] = {}
        self.deferred = Deferred()
        self._known: dict[str, PackType] = {}
        self._greeted: set[str] = set()
        self._refused: set[str] = set()
        self._bench = WorkRecord()
        self._types = PackTypes(self._bench.record)
        self._stepping = BlockProcessor(self._bench.record, self._counters, wall)

    @classmethod
    def restore(cls, number: int, table: Table, data: bytes, *, wall: Callable[[], float] = time.time) -> Self:
        """Go on from a snapshot's bytes.

        Raises:
            CheckpointError: They are damaged, of another partition, or of a version that is not known.
        """
        found = read_checkpoint(data)
        if found.number != number:
            raise CheckpointError(f"the checkpoint is of partition {found.number}, not of {number}")
        made = cls(number, table, wall=wall)
        made.sequence = found.sequence
        made._counters.update(found.counters)
        made._packs.update(found.packs)
        made._former.update(found.former)
        made.deferred = Deferred(found.deferred)
        return made

    def snapshot(self) -> PartitionCheckpoint:
        """Return a snapshot of the partition; it costs only a copied list of packs."""
        spans = self.deferred.spans()
        return PartitionCheckpoint(
            self.number, self.sequence, dict(self._counters), dict(self._packs), dict(self._former), spans
        )

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters since the partition began."""
        return {**self._counters, "packs": len(self._packs) + len(self._former), "unknown": len(self.unknown)}

    @property
    def unknown(self) -> tuple[str, ...]:
        """Unknown packs with messages."""
        return tuple(pack for pack in self.deferred if not self.is_known(pack))

    def state(self, pack: str) -> NDArray[np.void] | None:
        """Return a copy of a pack's record, shape (1,), dtype PACK_STATE; None if this version has none."""
        packed = self._packs.get(pack)
        if packed is None:
            return None
        self._bench.put(packed)
        return self._bench.record.copy()

    def take(self, pack: str, data: bytes, sequence: int) -> BlockResult:
        """Take a message of the stream, or defer it where its pack is not known or has others that wait.

        Args:
            pack: Name of the sending pack.
            data: A block, or what an edge sends for one: faults are counted by kind.
            sequence: In the stream; one that was taken is not taken again.
        """
        if sequence <= self.sequence:
            self._counters["repeated"] += 1
            return BlockResult(pack)
        if pack in self.deferred:
            return self.defer(pack, sequence)
        self.sequence = sequence
        block = self._decoded(data)
        if block is None:
            return BlockResult(pack)
        known = self._look_up(pack)
        if known is None:
            return self.defer(pack, sequence)
        return self._take(pack, block, known)

    def defer(self, pack: str, sequence: int) -> BlockResult:
        """Leave a message in the stream until its pack's turn."""
        self.sequence = max(self.sequence, sequence)
        if pack in self.deferred or len(self.deferred) < MAX_UNKNOWN or self.is_known(pack):
            self.deferred.add(pack, sequence)
            self._counters["deferred"] += 1
        else:
            self._counters["not_deferred"] += 1
        return BlockResult(pack)

    def take_deferred(self, pack: str, data: bytes, sequence: int) -> BlockResult:
        """Take the next message of a known pack that waits; arguments as in ``take``."""
        known = self._look_up(pack)
        if known is None or pack not in self.deferred:
            return BlockResult(pack)
        self.deferred.advance(pack, sequence)
        block = self._decoded(data)
        return self._take(pack, block, known) if block else BlockResult(pack)

    def is_known(self, pack: str) -> bool:
        """Return whether the table has the pack."""
        return self._table(pack) is not None

    def refuse(self, pack: str, sequence: int) -> BlockResult:
        """Leave out a message that is not in its pack's partition, whoever put it there."""
        if sequence > self.sequence:
            self.sequence = sequence
            self._counters["misplaced"] += 1
            self._log_refusal(pack, "the pack belongs to another partition")
        return BlockResult(pack)

    def settings_changed(self, pack: str) -> None:
        """Read the settings of a pack from the table again with its next block."""
        self._known.pop(pack, None)

    def _decoded(self, data: bytes) -> Block | None:
        """Return the block in a message; None: it is damaged."""
        try:
            return decode(data)
        except BlockError:
            self._counters["damaged"] += 1
            return None

    def _look_up(self, pack: str) -> PackType | None:
        known = self._known.get(pack)
        if known is None:
            found = self._table(pack)
            if found is None:
                return None
            known = self._known[pack] = self._types.of(*found)
        return known

    def _take(self, pack: str, block: Block, of_type: PackType) -> BlockResult:
        former = self._open(pack)
        d = self._bench.delivery
        lost = int(d["lost_blocks"])
        self._put_former_delivery(pack)
        order = classify_block(d, block)
        lost = int(d["lost_blocks"]) - lost
        self._bench.count_lost(lost)
        made = BlockResult(pack)
        if order is BlockOrder.NEXT:
            stepped, fault = None, density_fault(block.samples)
            if fault:
                self._log_refusal(pack, fault)
            else:
                stepped = self._step(pack, block, of_type, former)
            if stepped is None:  # as if it had brought nothing
                self._open(pack)
                self._put_former_delivery(pack)
                classify_block(d, block)
                self._bench.count_lost(lost)
                self._counters["too_dense" if fault else "failed"] += 1
            made = stepped or BlockResult(pack, failed=int(not fault))
            mark_taken(d)
            self._former.pop(pack, None)
            self._former_deliveries.pop(pack, None)
        else:
            self._counters[order.value] += 1
            if former is not None:  # its estimator is not made yet; the count of resent blocks must go on
                self._former_deliveries[pack] = d.copy()
        if (
            order is BlockOrder.NEXT or former is None
        ):  # what another version left stays as it is until a block is taken
            self._counters["lost_blocks"] += lost
            self._packs[pack] = self._bench.take()
        first = pack not in self._greeted
        self._greeted.add(pack)
        return made._replace(awaits=edge_reply(order, d, block, first=first))

    def _put_former_delivery(self, pack: str) -> None:
        """Add the counts of blocks since the start for a pack with a record of another layout."""
        if pack in self._former_deliveries:
            self._bench.record["delivery"][0] = self._former_deliveries[pack]

    def _log_refusal(self, pack: str, why: str) -> None:
        """Log the first refused block of a pack; ``counters`` has the others."""
        if pack not in self._refused:
            self._refused.add(pack)
            log.warning("a block is refused", partition=self.number, pack=pack, reason=why)

    def _step(self, pack: str, block: Block, of_type: PackType, former: Fields | None) -> BlockResult | None:
        """Process the next block; None if it cannot be processed."""
        try:
            return BlockResult(pack, None, *self._stepping.step(pack, block, of_type, former))
        except Exception:  # an internal error with one block: awaiting it forever would stop the pack
            log.exception("a block is left out", partition=self.number, pack=pack, number=block.number)
        self._stepping.forget()
        return None

    def _open(self, pack: str) -> Fields | None:
        """Lay a pack on the bench. A record of another layout also gets the estimator's fields, which it lacks."""
        packed, former = self._packs.get(pack), self._former.get(pack)
        try:
            if packed is not None:
                self._bench.put(packed)
                return None
            if former is not None:
                return self._bench.put_former(dtype_of(former.layout), former.packed)
        except ValueError:  # no checkpoint that was read can be so
            self._counters["damaged_states"] += 1
        self._bench.clear()
        return None
