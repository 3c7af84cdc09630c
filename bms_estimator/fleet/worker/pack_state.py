"""State of one pack in a worker: awaited block, totals, sums of the hour, estimator record.

The record is stored packed (``kernels.packed_record``) in immutable bytes, so that a snapshot of a partition needs no
copy. An edge's store is identified by its creation time [ns since 1970]; see ``edge.block``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import fields
from bms_estimator.checkpoint.restore import copy_known_fields
from bms_estimator.fleet.worker.cell_summary import CELL_SUMS
from bms_estimator.kernels.accumulators.charge_energy import FLOW_SUMS
from bms_estimator.kernels.accumulators.hour import HOUR_SUMS
from bms_estimator.kernels.packed_record import WORD_BYTES, pack, packed_buffer, symmetry_map, unpack
from bms_estimator.kernels.records import ESTIMATOR_STATE

Fields = Mapping[str, NDArray[Any]]
"""Fields of a record by name; a nested field is named ``part.field``."""
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
        # error of the edge's clock in the last block of this hour with an error beyond the limits of ``edge_clock`` [s];
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
"""Total charge and energy (``telemetry.charge_energy.ChargeEnergy``) and the sums of ``ChargeEnergyMeter``."""
PACK_STATE = np.dtype(
    [
        ("delivery", DELIVERY),
        ("flow", FLOW),
        ("hour", HOUR_SUMS),
        ("cells", CELL_SUMS),
        ("estimator", ESTIMATOR_STATE),
    ],
    align=True,
)


class StateError(ValueError):
    """Invalid bytes of a packed record."""


class UnpackedRecord:
    """Unpacked record into which the packs of a partition are loaded in turn.

    Attributes:
        record: Shape (1,), dtype ``PACK_STATE``.
    """

    def __init__(self, dtype: np.dtype[Any] = PACK_STATE) -> None:
        self.record: NDArray[np.void] = np.zeros(1, dtype)
        self._words = self.record.view(np.uint64)
        # Words below the diagonal of a covariance usually equal their mirror words and are then not stored.
        self._symmetric_words = symmetry_map(dtype)
        self._buffer = packed_buffer(self._words.size)

    @property
    def delivery(self) -> np.void:
        """Part of dtype ``DELIVERY``."""
        part: np.void = self.record[0]["delivery"]
        return part

    def clear(self) -> None:
        """Set all fields to zero, the state of a new pack."""
        self._words.fill(0)

    def load(self, packed: bytes) -> None:
        """Unpack a pack's record into this one.

        Raises:
            StateError: The bytes do not have this layout.
        """
        are_words = len(packed) % WORD_BYTES == 0
        if not (are_words and unpack(np.frombuffer(packed, np.uint64), self._symmetric_words, self._words)):
            raise StateError(f"{len(packed)} bytes are not a packed record")

    def load_previous_layout(self, dtype: np.dtype[Any], packed: bytes) -> Fields | None:
        """Unpack a pack's record of another layout. Copy its fields that exist in this layout.

        The estimator's fields are copied only if the layout of the estimator is the same, because they depend on each other.

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
        if not has_same_estimator:
            return estimator_fields
        self.record["estimator"] = previous.record["estimator"]
        return None

    def count_lost(self, blocks: int) -> None:
        """Count blocks of this hour as lost."""
        hour = self.record[0]["hour"]
        hour["lost_blocks"] = min(int(hour["lost_blocks"]) + blocks, MAX_LOST_BLOCKS)

    def packed_bytes(self) -> bytes:
        """Return the packed record."""
        return self._buffer[: pack(self._words, self._symmetric_words, self._buffer)].tobytes()
