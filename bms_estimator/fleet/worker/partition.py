"""States of the packs of one partition, updated block by block.

The states depend only on the order of the stream and on the table of packs. From any checkpoint on, equal blocks lead to
bit-identical states. The module performs no I/O, and uses the clock only for publish times.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Self

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.edge.block import Block, BlockError, BlockHeader, decode, decode_header
from bms_estimator.fleet.fits.messages import decode_result, is_fit
from bms_estimator.fleet.packs.pack_type import PackType
from bms_estimator.fleet.packs.table_change import is_change
from bms_estimator.fleet.worker.block_order import (
    Arrival,
    BlockOrder,
    UnsavedPositions,
    classify_block,
    density_fault,
    edge_reply,
    mark_processed,
    position,
)
from bms_estimator.fleet.worker.block_processor import BlockProcessor
from bms_estimator.fleet.worker.block_result import INTERNAL_ERROR, LETHAL, BlockResult
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import (
    CheckpointError,
    PartitionCheckpoint,
    read_checkpoint,
)
from bms_estimator.fleet.worker.deferred import MAX_DEFERRED_PACKS, Deferred
from bms_estimator.fleet.worker.pack_records import PackRecords
from bms_estimator.fleet.worker.pack_state import Fields
from bms_estimator.fleet.worker.table_in_force import PackLookup, PackSources, TableInForce
from bms_estimator.kernels.cells.records import CELL

log = structlog.get_logger(__name__)


class Partition:
    """Packs of one partition with their states.

    Args:
        number: Number of the partition.
        table: Settings and models of the packs.
        sources: Rows of the same table. With them, a change of a row takes effect at its position in the stream; None: at once.
        wall: Wall clock for publish times [s since 1970].

    Attributes:
        number: Number of the partition.
        sequence: Stream sequence number of the last processed or deferred message; 0: none.
        in_force: Table of packs that is in force at this position of the stream.
        deferred: Queue of packs with deferred messages.
        events: Numbers of blocks, samples and events in this process by name.
        clock_errors: Error of the edge's clock by pack [s], positive if ahead, if it is beyond the limits of ``block_order``. An
            entry remains to the end of the hour, on that clock, of the last block with an error.
    """

    def __init__(
        self,
        number: int,
        table: PackLookup,
        *,
        sources: PackSources | None = None,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.number, self.sequence = number, 0
        self._former_events: Mapping[str, int] = {}  # in earlier processes
        self.events = Counter[str]()
        self._records = PackRecords(self.events)
        self._processor = BlockProcessor(self._records.unpacked, self.events, wall)
        self.in_force = TableInForce(table, sources, self._processor.types)
        self.deferred = Deferred()
        self.clock_errors: dict[str, float] = {}
        self._unsaved = UnsavedPositions()
        self._replied: set[str] = set()  # packs whose edge has had a reply from this worker
        self._logged_rejections: set[str] = set()

    @classmethod
    def restore(
        cls,
        number: int,
        table: PackLookup,
        data: bytes,
        *,
        sources: PackSources | None = None,
        wall: Callable[[], float] = time.time,
    ) -> Self:
        """Restore a partition from the bytes of a checkpoint.

        Raises:
            CheckpointError: The bytes are damaged, of another partition, or of an unknown format.
        """
        checkpoint = read_checkpoint(data)
        if checkpoint.number != number:
            raise CheckpointError(f"the checkpoint is of partition {checkpoint.number}, not of {number}")
        partition = cls(number, table, sources=sources, wall=wall)
        partition.in_force.restore(checkpoint.in_force)
        partition.sequence = checkpoint.sequence
        partition._former_events = checkpoint.counters
        partition._records.restore(checkpoint.packs, checkpoint.other_layouts)
        partition.deferred = Deferred(checkpoint.deferred)
        return partition

    def snapshot(self) -> PartitionCheckpoint:
        """Return a snapshot of the partition."""
        packs, other_layouts = self._records.snapshot()
        return PartitionCheckpoint(
            number=self.number,
            sequence=self.sequence,
            counters=self._all_events(),
            packs=packs,
            other_layouts=other_layouts,
            deferred=self.deferred.spans(),
            in_force=dict(self.in_force.rows),
            changed=self._unsaved.begin_save(),
        )

    def mark_saved(self, *, is_whole: bool) -> None:
        """Record that the last snapshot was saved, so that replies confirm safe blocks to the edges.

        Args:
            is_whole: True for a whole checkpoint; False for an increment of the last one.
        """
        self._unsaved.end_save(is_whole=is_whole)

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters since the creation of the partition, including those of former workers."""
        return {
            **self._all_events(),
            "packs": len(self._records),
            "unknown": len(self.unknown),
        }

    def _all_events(self) -> dict[str, int]:
        former = self._former_events
        return {**former, **{name: former.get(name, 0) + count for name, count in self.events.items()}}

    @property
    def unknown(self) -> tuple[str, ...]:
        """Unknown packs with deferred messages."""
        return tuple(pack for pack in self.deferred if not self.in_force.is_known(pack))

    def state(self, pack: str) -> NDArray[np.void] | None:
        """Return a copy of a pack's record, shape (1,), dtype ``PACK_STATE``; None if it has another layout or does not exist."""
        if not self._records.is_current(pack):
            return None
        self._records.load(pack)
        return self._records.unpacked.record.copy()

    def cells(self, pack: str) -> NDArray[np.void]:
        """Return a copy of the states of a pack's single cells, shape (m,), dtype ``CELL``; m is 0 without any."""
        if not self._records.is_current(pack):
            return np.zeros(0, CELL)
        self._records.load(pack)
        return self._records.unpacked.cells.copy() if self._records.unpacked.cell_count else np.zeros(0, CELL)

    def process(
        self, pack: str, data: bytes, sequence: int, received_s: int | None = None, *, is_lethal: bool = False
    ) -> BlockResult:
        """Process a message of the stream, or defer it if its pack is unknown or has other deferred messages.

        Args:
            pack: Name of the sending pack.
            data: Bytes of a block; if they cannot be decoded, the message is counted and skipped.
            sequence: Stream sequence number. A message that was already processed is counted and skipped.
            received_s: Server's clock at the arrival of the message [s since 1970]; None: unknown, so that the edge's clock
                is not checked.
            is_lethal: Skip the block, because it has killed workers (``takeover``).
        """
        if sequence <= self.sequence:
            self.events["repeated"] += 1
            return BlockResult(pack)
        if pack in self.deferred:
            return self.defer(pack, sequence)
        self.sequence = sequence
        if is_change(data):
            return self._apply_change(pack, data)
        pack_type = self.in_force.look_up(pack)
        if pack_type is None:
            is_block = not is_fit(data) and isinstance(self._decode(data), Block)
            return self.defer(pack, sequence) if is_block else BlockResult(pack)
        return self._process_fit_or_block(pack, data, Arrival(sequence, received_s), pack_type, is_lethal=is_lethal)

    def defer(self, pack: str, sequence: int) -> BlockResult:
        """Defer a message: it stays in the stream until its pack is served."""
        self.sequence = max(self.sequence, sequence)
        if pack in self.deferred or len(self.deferred) < MAX_DEFERRED_PACKS or self.in_force.is_known(pack):
            self.deferred.add(pack, sequence)
            self.events["deferred"] += 1
        else:
            self.events["not_deferred"] += 1
        return BlockResult(pack, is_deferred=True)

    def process_deferred(
        self, pack: str, data: bytes, sequence: int, received_s: int | None = None, *, is_lethal: bool = False
    ) -> BlockResult:
        """Process the next deferred message of a known pack. ``process`` describes the arguments."""
        pack_type = self.in_force.look_up(pack)
        if pack_type is None or pack not in self.deferred:
            return BlockResult(pack, is_deferred=True)
        self.deferred.advance(pack, sequence)
        if is_change(data):
            return self._apply_change(pack, data)
        return self._process_fit_or_block(pack, data, Arrival(sequence, received_s), pack_type, is_lethal=is_lethal)

    def reject_misplaced(self, pack: str, sequence: int) -> BlockResult:
        """Skip and count a message of a pack that belongs to another partition."""
        if sequence > self.sequence:
            self.sequence = sequence
            self.events["misplaced"] += 1
            self._log_rejection(pack, "the pack belongs to another partition")
        return BlockResult(pack)

    def _apply_change(self, pack: str, data: bytes) -> BlockResult:
        """Apply a change of a pack's row to the following blocks of the pack."""
        try:
            self.in_force.apply_change(pack, data)
        except ValueError:
            self.events["damaged"] += 1
        else:
            self.events["table_changes"] += 1
        return BlockResult(pack)

    def _receive_fit(self, pack: str, data: bytes, sequence: int, pack_type: PackType) -> BlockResult:
        """Store the result of a fit in the record of its pack, if the pack has requested it."""
        records = self._records
        try:
            result = decode_result(data)
        except ValueError:
            self.events["damaged"] += 1
            return BlockResult(pack)
        # the result is ignored if the record has another version's layout, which the next block migrates
        if records.is_current(pack) and records.load(pack) is None:
            if self._processor.receive_fit(result, sequence, pack_type):
                self._unsaved.add(pack, position(records.unpacked.delivery))
                records.store(pack)
            else:
                self.events["stale_fits"] += 1
        return BlockResult(pack)

    def _process_fit_or_block(
        self, pack: str, data: bytes, arrival: Arrival, pack_type: PackType, *, is_lethal: bool
    ) -> BlockResult:
        """Process a fit or a block of a known pack. Of a lethal block only the header is decoded."""
        if is_fit(data):
            return self._receive_fit(pack, data, arrival.sequence, pack_type)
        block = self._decode(data, decode_header if is_lethal else decode)
        if isinstance(block, BlockError):
            self._log_rejection(pack, str(block))
            return BlockResult(pack, dead_reason=str(block))
        return self._process_block(pack, block, arrival, pack_type)

    def _decode(self, data: bytes, decode_block: Callable[[bytes], BlockHeader] = decode) -> BlockHeader | BlockError:
        """Return the block in a message, or only its header; if the message is damaged, return the error."""
        try:
            return decode_block(data)
        except BlockError as error:
            self.events["damaged"] += 1
            return error

    def _process_block(self, pack: str, block: BlockHeader, arrival: Arrival, pack_type: PackType) -> BlockResult:
        """Process a block of a known pack, or skip a lethal one, of which only the header was decoded.

        A record with another version's layout is migrated by the next block in order. Any other block changes only the pack's
        delivery record, which is then stored apart from the unmigrated record.
        """
        records = self._records
        unmigrated_fields = records.load(pack)
        delivery = records.unpacked.delivery
        stored_lost = int(delivery["lost_blocks"])
        records.load_unmigrated_delivery(pack)
        self._unsaved.add(pack, position(delivery))
        order = classify_block(delivery, block)
        newly_lost = int(delivery["lost_blocks"]) - stored_lost  # since the record was stored
        records.unpacked.count_lost(newly_lost)
        if order is BlockOrder.NEXT:
            result = self._process_next(pack, block, arrival, pack_type, unmigrated_fields, newly_lost)
        else:
            result = BlockResult(pack)
            self.events[order.value] += 1
        if order is BlockOrder.NEXT or unmigrated_fields is None:
            self.events["lost_blocks"] += newly_lost
            records.store(pack)
        else:
            records.store_unmigrated_delivery(pack)
        is_first = pack not in self._replied
        self._replied.add(pack)
        safe = self._unsaved.safe(pack, position(delivery))
        return result._replace(reply=edge_reply(order, int(delivery["ahead"]), block, safe, is_first=is_first))

    def _process_next(
        self,
        pack: str,
        block: BlockHeader,
        arrival: Arrival,
        pack_type: PackType,
        unmigrated_fields: Fields | None,
        newly_lost: int,
    ) -> BlockResult:
        """Estimate the block that the loaded pack awaits, or skip it.

        Args:
            pack: Name of the pack.
            block: The block; only its header if it is lethal.
            arrival: Arrival of the block at the server.
            pack_type: Type of the pack.
            unmigrated_fields: Estimator fields that another version saved; None if they are already in the record.
            newly_lost: Number of blocks that were lost since the record was stored.
        """
        skip_counter = ""
        if not isinstance(block, Block):
            result, skip_counter = BlockResult(pack, dead_reason=LETHAL), "lethal"
            self._log_rejection(pack, LETHAL)
        elif fault := density_fault(block.samples):
            result, skip_counter = BlockResult(pack), "too_dense"
            self._log_rejection(pack, fault)
        elif estimated := self._estimate(pack, block, arrival, pack_type, unmigrated_fields):
            result = estimated
        else:
            result, skip_counter = BlockResult(pack, failed=1, dead_reason=INTERNAL_ERROR), "failed"
        records = self._records
        delivery = records.unpacked.delivery
        if skip_counter:
            records.load(pack)  # an internal error may have changed the record
            records.load_unmigrated_delivery(pack)
            classify_block(delivery, block)
            records.unpacked.count_lost(newly_lost)
            self.events[skip_counter] += 1
        mark_processed(delivery)
        self._update_clock_error(pack, float(delivery["clock_error_s"]))
        return result

    def _update_clock_error(self, pack: str, error_s: float) -> None:
        """List a pack with the error of its edge's clock, and log a new error; 0 removes the pack from the list."""
        if not error_s:
            self.clock_errors.pop(pack, None)
            return
        if pack not in self.clock_errors:
            log.warning(
                "the clock of an edge is wrong: its hours are quarantined",
                partition=self.number,
                pack=pack,
                clock_error_s=round(error_s),
            )
        self.clock_errors[pack] = error_s

    def _log_rejection(self, pack: str, reason: str) -> None:
        """Log the first rejected block of a pack; ``counters`` counts all."""
        if pack not in self._logged_rejections:
            self._logged_rejections.add(pack)
            log.warning("a block is rejected", partition=self.number, pack=pack, reason=reason)

    def _estimate(
        self, pack: str, block: Block, arrival: Arrival, pack_type: PackType, unmigrated_fields: Fields | None
    ) -> BlockResult | None:
        """Estimate the next block; None after an internal error."""
        try:
            return self._processor.step(pack, block, arrival, pack_type, unmigrated_fields)
        except Exception:  # an internal error with one block must not stop the pack
            log.exception("a block is skipped", partition=self.number, pack=pack, number=block.number)
        self._processor.reset_window()
        return None
