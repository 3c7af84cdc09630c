"""Records of a raw capture (``sources.captures.raw_capture`` has the format) taken apart, a megabyte at a time."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.framing import Bytes, crc16, read_unsigned

ARRIVAL_BYTES = 8
LENGTH_BYTES = 4
CRC_BYTES = 2
HEAD_BYTES = ARRIVAL_BYTES + LENGTH_BYTES
RECORD_OVERHEAD_BYTES = HEAD_BYTES + CRC_BYTES


@njit(cache=True)
def split_records(
    raw: Bytes,
    longest: int,
    arrival_bits: NDArray[np.int64],
    ends: NDArray[np.int64],
    payload: Bytes,
) -> tuple[int, int, int, int]:
    """Take whole records from the start of ``raw``.

    Args:
        raw: Records, the last of them perhaps cut off.
        longest: Bytes that a record may hold; a length above is damage.
        arrival_bits: Output, shape (n,): arrival times, the bits of a float64.
        ends: Output, shape (n,): where in ``payload`` each record's bytes end.
        payload: Output: the bytes, one record behind the other.

    Returns:
        Bytes taken from ``raw``, records, bytes of payload, and 1 when what follows is damaged rather than cut off.
    """
    position = records = filled = 0
    while records < ends.size:
        if raw.size - position < RECORD_OVERHEAD_BYTES:
            return position, records, filled, 0
        length = read_unsigned(raw, position + ARRIVAL_BYTES, LENGTH_BYTES)
        if length > longest:
            return position, records, filled, 1
        body = position + HEAD_BYTES
        end = body + length
        if raw.size - end < CRC_BYTES:
            return position, records, filled, 0
        if crc16(raw, position, end) != read_unsigned(raw, end, CRC_BYTES):
            return position, records, filled, 1
        arrival_bits[records] = read_unsigned(raw, position, ARRIVAL_BYTES)
        payload[filled : filled + length] = raw[body:end]
        filled += length
        ends[records] = filled
        records += 1
        position = end + CRC_BYTES
    return position, records, filled, 0
