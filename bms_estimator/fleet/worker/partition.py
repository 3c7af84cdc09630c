"""States of the packs of one partition, updated block by block by the kernel that all commands share.

The states depend only on the order of the stream and on the table of packs. From any checkpoint on, equal blocks lead to
bit-identical states. The module performs no I/O, and uses the clock only for publish times.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol, Self

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.edge.block import Block, BlockError, BlockHeader, decode, decode_header
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.packs.pack_type import PackType, PackTypes
from bms_estimator.fleet.packs.table_change import PackSource, decode_change, encode_change, is_change
from bms_estimator.fleet.worker.block_order import BlockOrder, classify_block, edge_reply, mark_taken, position
from bms_estimator.fleet.worker.block_processor import BlockProcessor
from bms_estimator.fleet.worker.checkpoint.cell_layouts import cell_count, cell_layout
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import (
    CheckpointError,
    PartitionCheckpoint,
    read_checkpoint,
)
from bms_estimator.fleet.worker.checkpoint.record_layout import RecordWithLayout, dtype_of
from bms_estimator.fleet.worker.deferred import MAX_UNKNOWN, Deferred
from bms_estimator.fleet.worker.density import density_fault
from bms_estimator.fleet.worker.edge_clock import Arrival
from bms_estimator.fleet.worker.pack_state import Fields, UnpackedRecord
from bms_estimator.fleet.worker.unsaved_positions import UnsavedPositions
from bms_estimator.kernels.cells.records import CELL
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.settings.pack import Settings

PackLookup = Callable[[str], tuple[Settings, PackModel] | None]
"""Function that returns settings and model of a pack; None: the pack is unknown."""


class PackSources(Protocol):
    """Table of packs whose changes are applied in the order of the stream (``PackRegistry``)."""

    def source(self, pack: str) -> PackSource | None:
        """Return the present row and cell file of a pack; None if the pack is unknown."""

    def resolve(self, source: PackSource) -> tuple[Settings, PackModel] | None:
        """Return settings and model of a row and a cell file; None if they have an error."""


LETHAL = "the workers that processed it have died"
"""Reason for the dead letter of a lethal block."""
INTERNAL_ERROR = "internal error; the log of the worker has the traceback"
"""Reason for the dead letter of a block that was skipped because of an internal error."""

log = structlog.get_logger(__name__)


class BlockResult(NamedTuple):
    """Result of a message.

    Attributes:
        pack: Name of the pack.
        reply: Reply to the edge; None if no reply is due.
        state: Payload of topic ``state``; None without one.
        parameters: Payload of topic ``parameters``; None without one.
        cells: Payload of topic ``cells``; None without one.
        hours: Message ids and rows of finished hours. The message id of a row is equal for all workers, so that the server
            drops repeated rows.
        failed: Number of blocks that were skipped because of an internal error.
        dead_reason: Reason why the block becomes a dead letter; empty if it does not become one.
    """

    pack: str
    reply: BlockRequest | None = None
    state: bytes | None = None
    parameters: bytes | None = None
    cells: bytes | None = None
    hours: tuple[tuple[str, bytes], ...] = ()
    failed: int = 0
    dead_reason: str = ""


class CellPack(NamedTuple):
    """Packed record of a pack with single cells.

    Attributes:
        cells: Number of single cells.
        packed: The packed record.
    """

    cells: int
    packed: bytes


class Partition:
    """Packs of one partition with their states.

    Args:
        number: Number of the partition.
        table: Settings and models of the packs.
        sources: Rows of the same table, whose changes are applied in the order of the stream; None: a change takes effect
            at once.
        wall: Wall clock for publish times [s since 1970].

    Attributes:
        number: Number of the partition.
        sequence: Stream sequence number of the last processed or deferred message; 0: none.
        deferred: Queue of packs with deferred messages.
        clock_errors: Errors of edges' clocks beyond the limits of ``edge_clock``, by pack [s], positive if ahead. A pack is
            listed from a block with an error until the end of this hour on its clock.
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
        self._table, self._sources = table, sources
        self._in_force: dict[str, PackSource] = {}  # row and cell file of each pack with processed blocks
        self._counters: Counter[str] = Counter()
        self._packs: dict[str, bytes] = {}  # packs without single cells
        self._cell_packs: dict[str, CellPack] = {}
        self._unmigrated: dict[str, RecordWithLayout] = {}  # packs whose record still has a previous layout
        # delivery records of these packs, which only this process has updated since it restored the partition
        self._unmigrated_deliveries: dict[str, np.void] = {}
        self.deferred = Deferred()
        self.clock_errors: dict[str, float] = {}
        self._type_by_pack: dict[str, PackType] = {}
        self._unsaved = UnsavedPositions()
        self._replied: set[str] = set()  # packs whose edge has had a reply from this worker
        self._logged_rejections: set[str] = set()
        self._unpacked = UnpackedRecord()
        self._types = PackTypes(self._unpacked.record)
        self._processor = BlockProcessor(self._unpacked, self._counters, wall)

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
        partition._in_force.update(checkpoint.in_force)
        partition.sequence = checkpoint.sequence
        partition._counters.update(checkpoint.counters)
        partition._packs.update(checkpoint.packs)
        for pack, state in checkpoint.other_layouts.items():
            if cells := cell_count(state.layout):
                partition._cell_packs[pack] = CellPack(cells, state.packed)
            else:
                partition._unmigrated[pack] = state
        partition.deferred = Deferred(checkpoint.deferred)
        return partition

    def snapshot(self) -> PartitionCheckpoint:
        """Return a snapshot of the partition. Records are not copied, because they are immutable bytes."""
        changed = self._unsaved.begin_save()
        with_cells = {
            pack: RecordWithLayout(cell_layout(cells), packed) for pack, (cells, packed) in self._cell_packs.items()
        }
        return PartitionCheckpoint(
            number=self.number,
            sequence=self.sequence,
            counters=dict(self._counters),
            packs=dict(self._packs),
            other_layouts=self._unmigrated | with_cells,
            deferred=self.deferred.spans(),
            in_force=dict(self._in_force),
            changed=changed,
        )

    def mark_saved(self, *, is_whole: bool) -> None:
        """Record that the last snapshot was saved, so that replies confirm safe blocks to the edges.

        Args:
            is_whole: True for a whole checkpoint; False for an increment of the last one.
        """
        self._unsaved.end_save(is_whole=is_whole)

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters since the partition was created, over all its workers."""
        return {
            **self._counters,
            "packs": len(self._packs) + len(self._cell_packs) + len(self._unmigrated),
            "unknown": len(self.unknown),
        }

    @property
    def unknown(self) -> tuple[str, ...]:
        """Unknown packs with deferred messages."""
        return tuple(pack for pack in self.deferred if not self.is_known(pack))

    def state(self, pack: str) -> NDArray[np.void] | None:
        """Return a copy of a pack's record, shape (1,), dtype ``PACK_STATE``; None if it has another layout or does not exist."""
        if pack not in self._packs and pack not in self._cell_packs:
            return None
        self._load(pack)
        return self._unpacked.record.copy()

    def cells(self, pack: str) -> NDArray[np.void]:
        """Return a copy of the states of a pack's single cells, shape (m,), dtype ``CELL``; m is 0 without any."""
        if pack not in self._cell_packs:
            return np.zeros(0, CELL)
        self._load(pack)
        return self._unpacked.cells.copy()

    def take(
        self, pack: str, data: bytes, sequence: int, received_s: int | None = None, *, is_lethal: bool = False
    ) -> BlockResult:
        """Process a message of the stream, or defer it if its pack is unknown or has other deferred messages.

        Args:
            pack: Name of the sending pack.
            data: Bytes of a block; if they cannot be decoded, the message is counted and skipped.
            sequence: Stream sequence number. A message that was already processed is counted and skipped.
            received_s: Server's clock at the arrival of the message [s since 1970]; None: unknown, so that the edge's clock
                is not checked.
            is_lethal: Skip the block, because it has killed workers (``replay_guard``).
        """
        if sequence <= self.sequence:
            self._counters["repeated"] += 1
            return BlockResult(pack)
        if pack in self.deferred:
            return self.defer(pack, sequence)
        self.sequence = sequence
        if is_change(data):
            return self._apply_change(pack, data)
        pack_type = self._look_up(pack)
        if pack_type is None:
            is_block = isinstance(self._decode(data), Block)
            return self.defer(pack, sequence) if is_block else BlockResult(pack)
        return self._decode_and_take(pack, data, Arrival(sequence, received_s), pack_type, is_lethal=is_lethal)

    def defer(self, pack: str, sequence: int) -> BlockResult:
        """Defer a message: it stays in the stream until its pack is served."""
        self.sequence = max(self.sequence, sequence)
        if pack in self.deferred or len(self.deferred) < MAX_UNKNOWN or self.is_known(pack):
            self.deferred.add(pack, sequence)
            self._counters["deferred"] += 1
        else:
            self._counters["not_deferred"] += 1
        return BlockResult(pack)

    def take_deferred(
        self, pack: str, data: bytes, sequence: int, received_s: int | None = None, *, is_lethal: bool = False
    ) -> BlockResult:
        """Process the next deferred message of a known pack. ``take`` describes the arguments."""
        pack_type = self._look_up(pack)
        if pack_type is None or pack not in self.deferred:
            return BlockResult(pack)
        self.deferred.advance(pack, sequence)
        if is_change(data):
            return self._apply_change(pack, data)
        return self._decode_and_take(pack, data, Arrival(sequence, received_s), pack_type, is_lethal=is_lethal)

    def is_known(self, pack: str) -> bool:
        """Return True if the pack has valid settings."""
        return self._settings(pack) is not None

    def reject_misplaced(self, pack: str, sequence: int) -> BlockResult:
        """Skip and count a message of a pack that belongs to another partition."""
        if sequence > self.sequence:
            self.sequence = sequence
            self._counters["misplaced"] += 1
            self._log_rejection(pack, "the pack belongs to another partition")
        return BlockResult(pack)

    def settings_changed(self, pack: str) -> None:
        """Drop the cached settings of a pack, so that its next block looks them up again."""
        self._type_by_pack.pop(pack, None)

    @property
    def in_force(self) -> Mapping[str, PackSource]:
        """Row and cell file of each pack at this position of the stream."""
        return self._in_force

    def table_change(self, pack: str) -> bytes | None:
        """Return the message for the stream if the row of a pack in the table differs from the one in force; otherwise None."""
        if self._sources is None or pack not in self._in_force:
            return None
        source = self._sources.source(pack)
        return None if source == self._in_force[pack] else encode_change(source)

    def _apply_change(self, pack: str, data: bytes) -> BlockResult:
        """Apply a change of a pack's row to the following blocks of the pack."""
        try:
            source = decode_change(data)
        except ValueError:
            self._counters["damaged"] += 1
            return BlockResult(pack)
        self._counters["table_changes"] += 1
        if source is None:
            self._in_force.pop(pack, None)
        else:
            self._in_force[pack] = source
        self.settings_changed(pack)
        return BlockResult(pack)

    def _settings(self, pack: str) -> tuple[Settings, PackModel] | None:
        """Return the settings and the model in force. For a new pack, and for a row with an error, the table is read."""
        source = self._in_force.get(pack)
        in_force = self._sources.resolve(source) if self._sources is not None and source else None
        return in_force or self._table(pack)

    def _decode_and_take(
        self, pack: str, data: bytes, arrival: Arrival, pack_type: PackType, *, is_lethal: bool
    ) -> BlockResult:
        """Process a message of a known pack. Of a lethal block only the header is decoded."""
        block = self._decode(data, decode_header if is_lethal else decode)
        if isinstance(block, BlockError):
            self._log_rejection(pack, str(block))
            return BlockResult(pack, dead_reason=str(block))
        return self._take(pack, block, arrival, pack_type)

    def _decode(self, data: bytes, decode_block: Callable[[bytes], BlockHeader] = decode) -> BlockHeader | BlockError:
        """Return the block in a message or its header, or the error of a damaged one."""
        try:
            return decode_block(data)
        except BlockError as error:
            self._counters["damaged"] += 1
            return error

    def _look_up(self, pack: str) -> PackType | None:
        """Return the type of a pack; None if the pack is unknown."""
        pack_type = self._type_by_pack.get(pack)
        if pack_type is None:
            entry = self._settings(pack)
            if entry is None:
                return None
            source = self._sources.source(pack) if self._sources is not None else None
            if source is not None:
                self._in_force.setdefault(pack, source)
            pack_type = self._type_by_pack[pack] = self._types.of(*entry)
        return pack_type

    def _take(self, pack: str, block: BlockHeader, arrival: Arrival, pack_type: PackType) -> BlockResult:
        """Process a block of a known pack, or skip a lethal one, of which only the header was decoded."""
        unmigrated_fields = self._load(pack)
        d = self._unpacked.delivery
        stored_lost = int(d["lost_blocks"])
        self._restore_unmigrated_delivery(pack)
        self._unsaved.add(pack, position(d))
        order = classify_block(d, block)
        newly_lost = int(d["lost_blocks"]) - stored_lost  # since the record was stored
        self._unpacked.count_lost(newly_lost)
        result = BlockResult(pack)
        if order is BlockOrder.NEXT:
            stepped, fault, is_lethal = None, LETHAL, not isinstance(block, Block)
            if isinstance(block, Block):
                fault = density_fault(block.samples)
                stepped = None if fault else self._step(pack, block, arrival, pack_type, unmigrated_fields)
            if fault:
                self._log_rejection(pack, fault)
            if stepped is None:  # reload the record, which the failed block may have changed
                self._load(pack)
                self._restore_unmigrated_delivery(pack)
                classify_block(d, block)
                self._unpacked.count_lost(newly_lost)
                self._counters["lethal" if is_lethal else "too_dense" if fault else "failed"] += 1
            dead_reason = LETHAL if is_lethal else "" if fault else INTERNAL_ERROR
            result = stepped or BlockResult(pack, failed=int(not fault), dead_reason=dead_reason)
            mark_taken(d)
            self._update_clock_error(pack, float(d["clock_error_s"]))
            self._unmigrated.pop(pack, None)
            self._unmigrated_deliveries.pop(pack, None)
        else:
            self._counters[order.value] += 1
            if unmigrated_fields is not None:  # the record keeps its layout until a block is processed
                self._unmigrated_deliveries[pack] = d.copy()
        if order is BlockOrder.NEXT or unmigrated_fields is None:
            self._counters["lost_blocks"] += newly_lost
            self._store(pack)
        is_first = pack not in self._replied
        self._replied.add(pack)
        safe = self._unsaved.safe(pack, position(d))
        return result._replace(reply=edge_reply(order, int(d["ahead"]), block, safe, is_first=is_first))

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

    def _restore_unmigrated_delivery(self, pack: str) -> None:
        """Restore the delivery record of a pack whose stored record still has a previous layout."""
        if pack in self._unmigrated_deliveries:
            self._unpacked.record["delivery"][0] = self._unmigrated_deliveries[pack]

    def _log_rejection(self, pack: str, reason: str) -> None:
        """Log the first rejected block of a pack; ``counters`` counts all."""
        if pack not in self._logged_rejections:
            self._logged_rejections.add(pack)
            log.warning("a block is rejected", partition=self.number, pack=pack, reason=reason)

    def _step(
        self, pack: str, block: Block, arrival: Arrival, pack_type: PackType, unmigrated_fields: Fields | None
    ) -> BlockResult | None:
        """Estimate the next block; None after an internal error."""
        try:
            state, parameters, cells, hours = self._processor.step(pack, block, arrival, pack_type, unmigrated_fields)
            return BlockResult(pack, state=state, parameters=parameters, cells=cells, hours=hours)
        except Exception:  # an internal error with one block must not stop the pack
            log.exception("a block is skipped", partition=self.number, pack=pack, number=block.number)
        self._processor.reset_window()
        return None

    def _store(self, pack: str) -> None:
        """Store the unpacked record as the state of a pack."""
        packed, cells = self._unpacked.packed_bytes(), self._unpacked.cell_count
        if cells:
            self._cell_packs[pack] = CellPack(cells, packed)
            self._packs.pop(pack, None)
        else:
            self._packs[pack] = packed
            self._cell_packs.pop(pack, None)

    def _load(self, pack: str) -> Fields | None:
        """Load a pack into the unpacked record.

        Returns:
            The estimator fields by name if the estimator's part of the record has a previous layout; otherwise None.
        """
        packed = self._packs.get(pack)
        try:
            if packed is not None:
                self._unpacked.load(packed)
                return None
            if (cell_pack := self._cell_packs.get(pack)) is not None:
                self._unpacked.load(cell_pack.packed, cell_pack.cells)
                return None
            if (unmigrated := self._unmigrated.get(pack)) is not None:
                estimator_fields = self._unpacked.load_previous_layout(dtype_of(unmigrated.layout), unmigrated.packed)
                if estimator_fields is None:
                    self._store(pack)
                    del self._unmigrated[pack]
                return estimator_fields
        except ValueError:  # does not happen with a checkpoint whose checksums were correct
            self._counters["damaged_states"] += 1
        self._unpacked.clear()
        return None
