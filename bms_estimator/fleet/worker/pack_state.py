"""State of one pack in a worker: awaited block, totals, sums of the hour, estimator record, and estimators of single cells.

The estimators of single cells follow the record of dtype ``PACK_STATE`` only if the pack's blocks have cell voltages. The
record is stored packed (``kernels.packed_record``) in immutable bytes, so that a snapshot of a partition needs no copy. An
edge's store is identified by its creation time [ns since 1970]; see ``edge.block``.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.restore import copy_known_fields
from bms_estimator.fleet.fits.messages import COMPARED
from bms_estimator.kernels.accumulators.hour import HOUR_SUMS
from bms_estimator.kernels.accumulators.publish_window import FLOW_SUMS
from bms_estimator.kernels.alarms.records import ALARM, ALARMS
from bms_estimator.kernels.cells.records import BANK_STATE, CELL
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.kernels.packed_record import WORD_BYTES, pack, packed_buffer, symmetry_map, unpack
from bms_estimator.kernels.records import ESTIMATOR_STATE
from bms_estimator.model.arrays import fields
from bms_estimator.pack_model.saved import FIT_SHAPES

Fields = Mapping[str, NDArray[Any]]
"""Fields of a record by name; a nested field is named ``part.field``."""
MAX_CELLS = 128
"""Maximum number of cells in series with estimators of single cells."""
MAX_LOST_BLOCKS = 2**62
"""Limit of the count of lost blocks, so that it cannot overflow."""

# names of fields of ``DELIVERY``; checkpoints contain these names, so that they cannot be changed
LAST_STORE_NS, CONFIG_DIGEST, STATE_DIGEST = "clock", "made_of", "meaning"

DELIVERY = np.dtype(
    [
        # creation time of the store with the awaited block [ns since 1970]; 0: no block yet
        ("store", "u8"),
        # number of the awaited block, the next to be processed
        ("awaited", "u8"),
        # count of blocks that were received with a number above the awaited one
        ("ahead", "i8"),
        # lowest number among these early blocks; 0: none
        ("first_ahead", "u8"),
        # number of times that block ``first_ahead`` was received; after ``block_order.MAX_EARLY_REPEATS`` of them the
        # missing blocks count as lost
        ("passed", "i8"),
        # number of processed blocks
        ("blocks", "i8"),
        # number of blocks that were never received
        ("lost_blocks", "i8"),
        # creation time of the store that contains the last valid sample [ns since 1970]; 0: no sample yet
        (LAST_STORE_NS, "u8"),
        # timestamp of the last valid sample [s since ``LAST_STORE_NS``]
        ("last_s", "f8"),
        # current hour [hours since 1970]; 0: no block yet
        ("hour", "i8"),
        # error of the edge's clock in the last block of this hour with an error beyond the limits of ``block_order`` [s];
        # 0: none
        ("clock_error_s", "f8"),
        # ``PackType.config_digest`` of the settings with which the state was computed
        (CONFIG_DIGEST, "u8", 2),
        # ``PackType.state_digest`` of the settings that the state depends on
        (STATE_DIGEST, "u8", 2),
    ],
    align=True,
)
FLOW = np.dtype(
    [
        ("charge_out_ah", "f8"),
        ("charge_in_ah", "f8"),
        ("energy_out_kwh", "f8"),
        ("energy_in_kwh", "f8"),
        ("sums", FLOW_SUMS),
    ],
    align=True,
)
"""Total charge and energy (``telemetry.publish_window.ChargeEnergy``) and the sums of ``ChargeEnergyMeter``."""
PACK_FIT = np.dtype(
    [
        # stream sequence number of the message with the fit; 0: none
        ("sequence", "u8"),
        # minimum std of the filter's SOC at which the fit is adopted; infinite: never, for example because it failed
        ("min_filter_std", "f8"),
        # 1: the pack was exchanged before the fitted rows
        ("is_exchanged", "i8"),
        *((name, "f8", shape) for name, shape in FIT_SHAPES.items()),
    ],
    align=True,
)
"""Fit of a pack's history (``pack_model.fit.PackFit``), without the fields from which the next fit starts."""
FIT = np.dtype(
    [
        # stream sequence number of the block with the unanswered request for a fit; 0: none
        ("request", "u8"),
        # ``elapsed_s`` of the history at the request [s]
        ("begun_s", "f8"),
        # fit whose curves the filter uses
        ("in_force", PACK_FIT),
        # fit that waits for its adoption
        ("received", PACK_FIT),
        # 1: ``weakest`` is known
        ("has_weakest", "i8"),
        # weakest cell of a bank according to the last fits
        ("weakest", COMPARED),
    ],
    align=True,
)
"""Fits of a pack."""
PACK_STATE = np.dtype(
    [
        ("delivery", DELIVERY),
        ("flow", FLOW),
        ("hour", HOUR_SUMS),
        ("fit", FIT),
        ("alarms", ALARMS),
        ("estimator", ESTIMATOR_STATE),
    ],
    align=True,
)
BANK_FIELD, CELLS = "cell_bank", "single_cells"
"""Names of the fields of the single cells; checkpoints contain these names, so that they cannot be changed."""


@lru_cache(maxsize=MAX_CELLS + 1)
def pack_dtype(cells: int) -> np.dtype[Any]:
    """Return the dtype of a pack's record with the estimators of ``cells`` single cells; ``PACK_STATE`` for 0."""
    if not cells:
        return PACK_STATE
    parts = [(name, PACK_STATE[name]) for name in PACK_STATE.names or ()]
    return np.dtype([*parts, (BANK_FIELD, BANK_STATE), (CELLS, CELL, (cells,))], align=True)


class StateError(ValueError):
    """Invalid bytes of a packed record."""


class UnpackedRecord:
    """Unpacked record into which the packs of a partition are loaded in turn.

    Args:
        dtype: Dtype of a record of another layout; default: ``PACK_STATE``, with up to ``MAX_CELLS`` single cells.

    Attributes:
        record: Shape (1,), dtype ``PACK_STATE`` or the given dtype.
        cell_count: Number of single cells with an estimator; 0 without cell voltages.
    """

    def __init__(self, dtype: np.dtype[Any] | None = None) -> None:
        dtype, largest = (PACK_STATE, pack_dtype(MAX_CELLS)) if dtype is None else (dtype, dtype)
        self._all_words = np.zeros(largest.itemsize // WORD_BYTES, np.uint64)
        self._buffer = packed_buffer(self._all_words.size)
        self._base_dtype = dtype
        self._set_cell_count(0)
        self.record: NDArray[np.void] = self._words.view(dtype)
        self._scratch = [self.record["estimator"]["filter"][name] for name in SCRATCH] if dtype is PACK_STATE else []

    def _set_cell_count(self, cells: int) -> None:
        dtype = pack_dtype(cells) if cells else self._base_dtype
        self.cell_count = cells
        self._words = self._all_words[: dtype.itemsize // WORD_BYTES]
        # words below the diagonal of a covariance are not stored if they equal their mirror words
        self._symmetric_words = symmetry_map(dtype)

    @property
    def bank(self) -> NDArray[np.void]:
        """State that the single cells share, shape (1,), dtype ``BANK_STATE``."""
        bank: NDArray[np.void] = self._words.view(pack_dtype(self.cell_count))[BANK_FIELD]
        return bank

    @property
    def cells(self) -> NDArray[np.void]:
        """States of the single cells, shape (cell_count,), dtype ``CELL``."""
        cells: NDArray[np.void] = self._words.view(pack_dtype(self.cell_count))[CELLS][0]
        return cells

    def start_cells(self, cells: int) -> None:
        """Add the initial state of ``cells`` single cells; 0 removes the single cells."""
        self._set_cell_count(cells)
        self._words[PACK_STATE.itemsize // WORD_BYTES :] = 0

    @property
    def delivery(self) -> np.void:
        """Part of dtype ``DELIVERY``."""
        part: np.void = self.record[0]["delivery"]
        return part

    def clear(self) -> None:
        """Set all fields to zero, the state of a new pack."""
        self._set_cell_count(0)
        self._words.fill(0)

    def load(self, packed: bytes, cells: int = 0) -> None:
        """Unpack a pack's record with ``cells`` single cells into this one.

        Raises:
            StateError: The bytes do not have this layout.
        """
        if cells != self.cell_count:
            self._set_cell_count(cells)
        are_words = len(packed) % WORD_BYTES == 0
        if not (are_words and unpack(np.frombuffer(packed, np.uint64), self._symmetric_words, self._words)):
            raise StateError(f"{len(packed)} bytes are not a packed record")

    def load_previous_layout(self, dtype: np.dtype[Any], packed: bytes) -> Fields | None:
        """Unpack a pack's record of another layout. Copy its fields that exist in this layout.

        The estimator's fields are copied only if the layout of the estimator is the same, because they depend on each other. The
        same applies to the single cells.

        Args:
            dtype: Dtype of the record.
            packed: The packed record.

        Returns:
            The fields of the estimator by name; None if they were copied.

        Raises:
            ValueError: The bytes do not have this dtype, or no pack's record can have it.
        """
        previous = UnpackedRecord(dtype)
        previous.load(packed)
        has_same_estimator = "estimator" in (dtype.names or ()) and dtype["estimator"] == PACK_STATE["estimator"]
        estimator_fields, other_fields = {}, {}
        for name, value in fields(previous.record):
            part, _, rest = name.partition(".")
            if part == "estimator":
                estimator_fields[rest] = value
            else:
                other_fields[name] = value
        self.clear()
        copy_known_fields(self.record, other_fields)
        states = self.record["alarms"]["states"]
        for name in ALARM.names or ():  # an earlier version has fewer alarms, in the same order
            saved = other_fields.get(f"alarms.states.{name}", states[name][:, :0])
            if saved.ndim == states.ndim and saved.shape[1] < states.shape[1]:
                states[name][:, : saved.shape[1]] = saved
        self._copy_cells(previous.record)
        if not has_same_estimator:
            return estimator_fields
        self.record["estimator"] = previous.record["estimator"]
        return None

    def _copy_cells(self, previous: NDArray[np.void]) -> None:
        """Copy the single cells of a record of another layout, if their own layout is the same."""
        names = previous.dtype.names or ()
        if not {BANK_FIELD, CELLS} <= set(names):
            return
        bank, cells = previous[BANK_FIELD], previous[CELLS]
        if bank.dtype == BANK_STATE and cells.dtype == CELL and cells.ndim == 2 and 0 < cells.shape[1] <= MAX_CELLS:
            self.start_cells(cells.shape[1])
            self.bank[...], self.cells[...] = bank, cells[0]

    def count_lost(self, blocks: int) -> None:
        """Count blocks of this hour as lost."""
        hour = self.record[0]["hour"]
        hour["lost_blocks"] = min(int(hour["lost_blocks"]) + blocks, MAX_LOST_BLOCKS)

    def packed_bytes(self) -> bytes:
        """Return the packed record, without ``SCRATCH``."""
        for array in self._scratch:
            array.fill(0.0)
        return self._buffer[: pack(self._words, self._symmetric_words, self._buffer)].tobytes()
