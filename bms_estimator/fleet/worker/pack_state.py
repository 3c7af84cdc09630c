"""State of one pack in a worker: next block, totals, sums of the hour, estimator record.

The record is stored packed (``kernels.packed_record``) in immutable bytes, so that a snapshot of a partition needs no copy.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import fields
from bms_estimator.checkpoint.restore import copy_known_fields
from bms_estimator.kernels.accumulators.charge_energy import FLOW_SUMS
from bms_estimator.kernels.accumulators.hour import HOUR_SUMS
from bms_estimator.kernels.packed_record import WORD_BYTES, pack, packed_buffer, symmetry_map, unpack
from bms_estimator.kernels.records import ESTIMATOR_STATE

Fields = Mapping[str, NDArray[Any]]
"""Fields of a record by name; a nested field is named ``part.field``."""
MAX_LOST_BLOCKS = 2**62
"""Limit of the count of lost blocks, so that it cannot overflow."""

DELIVERY = np.dtype(
    [
        ("store", "u8"),  # the edge's store with the awaited blocks [ns since 1970]; 0: no block yet
        ("awaited", "u8"),  # number of the next block
        ("ahead", "i8"),  # number of received blocks behind a missing one
        ("first_ahead", "u8"),  # lowest number of a block behind a missing one; 0: none
        ("passed", "i8"),  # how often block ``first_ahead`` was received
        ("blocks", "i8"),  # number of processed blocks
        ("lost_blocks", "i8"),  # number of blocks that were never received
        ("clock", "u8"),  # store of the last sample's block, the origin of its time stamps; 0: no sample yet
        ("last_s", "f8"),  # the last sample's time stamp [s]
        ("hour", "i8"),  # current hour [hours since 1970]; 0: no block yet
        ("made_of", "u8", 2),  # ``PackType.config_digest``
        ("meaning", "u8", 2),  # ``PackType.state_digest``
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
    [("delivery", DELIVERY), ("flow", FLOW), ("hour", HOUR_SUMS), ("estimator", ESTIMATOR_STATE)], align=True
)


class StateError(ValueError):
    """Invalid bytes of a packed record."""


class WorkRecord:
    """Work record: one unpacked record into which the packs of a partition are loaded in turn.

    Attributes:
        record: Shape (1,), dtype ``PACK_STATE``.
    """

    def __init__(self, dtype: np.dtype[Any] = PACK_STATE) -> None:
        self.record: NDArray[np.void] = np.zeros(1, dtype)
        self._words = self.record.view(np.uint64)
        self._mirror = symmetry_map(dtype)
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
        if not (are_words and unpack(np.frombuffer(packed, np.uint64), self._mirror, self._words)):
            raise StateError(f"{len(packed)} bytes are not a packed record")

    def load_previous_layout(self, dtype: np.dtype[Any], packed: bytes) -> Fields:
        """Unpack a pack's record of another layout into this one: the fields that exist here, except for the estimator.

        Args:
            dtype: Dtype of the record.
            packed: The packed record.

        Returns:
            The fields of the estimator by name.

        Raises:
            ValueError: The bytes do not have this dtype, or the dtype is not that of a pack.
        """
        former = WorkRecord(dtype)
        former.load(packed)
        estimator_fields, others = {}, {}
        for name, value in fields(former.record):
            part, _, rest = name.partition(".")
            if part == "estimator":
                estimator_fields[rest] = value
            else:
                others[name] = value
        self.clear()
        copy_known_fields(self.record, others)
        return estimator_fields

    def count_lost(self, blocks: int) -> None:
        """Count blocks of this hour as lost."""
        hour = self.record[0]["hour"]
        hour["lost_blocks"] = min(int(hour["lost_blocks"]) + blocks, MAX_LOST_BLOCKS)

    def packed_bytes(self) -> bytes:
        """Return the packed record."""
        return self._buffer[: pack(self._words, self._mirror, self._buffer)].tobytes()
