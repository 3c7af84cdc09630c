"""State of one pack in a worker: next block, totals, the hour's sums, the estimator's record.

One record of numbers, stored packed (``kernels.packed_record``) in immutable bytes, so that a holder keeps the pack
unchanged.
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
"""Fields of a record by name, those of parts as ``part.field``."""
MAX_LOST = 2**62
"""No more lost blocks are counted."""

DELIVERY = np.dtype(
    [
        ("store", "u8"),  # the edge's store with the awaited blocks [ns since 1970]; 0: no block yet
        ("awaited", "u8"),  # number of the next block
        ("ahead", "i8"),  # blocks after a missing one
        ("first_ahead", "u8"),  # lowest number of these; 0: none
        ("passed", "i8"),  # number of times that it was received
        ("blocks", "i8"),  # taken
        ("lost_blocks", "i8"),  # blocks that were never received
        ("clock", "u8"),  # store of the last sample's block, the origin of its time stamps; 0: no sample yet
        ("last_s", "f8"),  # the last sample's time stamp [s]
        ("hour", "i8"),  # that is summed up now [hours since 1970]; 0: none yet
        ("made_of", "u8", 2),  # digests of the type of the pack
        ("meaning", "u8", 2),
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
"""All that has flowed (``telemetry.charge_energy.ChargeEnergy``), and what ``ChargeEnergyMeter`` counts in."""
PACK_STATE = np.dtype(
    [("delivery", DELIVERY), ("flow", FLOW), ("hour", HOUR_SUMS), ("estimator", ESTIMATOR_STATE)], align=True
)


class StateError(ValueError):
    """The bytes of a pack are invalid."""


class WorkRecord:
    """A record on which one pack after the other is worked on.

    Attributes:
        record: Shape (1,), dtype ``PACK_STATE``.
    """

    def __init__(self, dtype: np.dtype[Any] = PACK_STATE) -> None:
        self.record: NDArray[np.void] = np.zeros(1, dtype)
        self._words = self.record.view(np.uint64)
        self._mirror = symmetry_map(dtype)
        self._packed = packed_buffer(self._words.size)

    @property
    def delivery(self) -> np.void:
        """The part of dtype ``DELIVERY``."""
        part: np.void = self.record[0]["delivery"]
        return part

    def clear(self) -> None:
        """Lay a pack there of which nothing is known."""
        self._words.fill(0)

    def put(self, packed: bytes) -> None:
        """Lay a pack there.

        Raises:
            StateError: It does not have this layout.
        """
        whole = len(packed) % WORD_BYTES == 0
        if not (whole and unpack(np.frombuffer(packed, np.uint64), self._mirror, self._words)):
            raise StateError(f"{len(packed)} bytes are no state of a pack")

    def put_former(self, dtype: np.dtype[Any], packed: bytes) -> Fields:
        """Store a pack's record of another layout, except for its estimator, as far as the fields match.

        Args:
            dtype: Dtype of its record.
            packed: It.

        Returns:
            The fields of its estimator, by their names.

        Raises:
            ValueError: It does not have this layout, or the layout is not that of a pack.
        """
        former = WorkRecord(dtype)
        former.put(packed)
        of_estimator, others = {}, {}
        for name, value in fields(former.record):
            part, _, rest = name.partition(".")
            if part == "estimator":
                of_estimator[rest] = value
            else:
                others[name] = value
        self.clear()
        copy_known_fields(self.record, others)
        return of_estimator

    def count_lost(self, blocks: int) -> None:
        """Count blocks of this hour as lost."""
        lost = self.record[0]["hour"]
        lost["lost_blocks"] = min(int(lost["lost_blocks"]) + blocks, MAX_LOST)

    def take(self) -> bytes:
        """Return the pack's record, packed."""
        return self._packed[: pack(self._words, self._mirror, self._packed)].tobytes()
