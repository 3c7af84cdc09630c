"""Parser of the records of a raw capture (format: ``sources.captures.raw_capture``), for one chunk of the file."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.framing import Bytes, crc16, read_unsigned

ARRIVAL_BYTES = 8
"""Length of the arrival time of a record [bytes]."""
LENGTH_BYTES = 4
"""Length of the length field of a record [bytes]."""
CRC_BYTES = 2
"""Length of the CRC of a record [bytes]."""
HEAD_BYTES = ARRIVAL_BYTES + LENGTH_BYTES
"""Length of a record before its payload [bytes]."""
RECORD_OVERHEAD_BYTES = HEAD_BYTES + CRC_BYTES
"""Length of a record without its payload [bytes]."""


@njit(cache=True)
def split_records(
    raw: Bytes,
    max_length: int,
    arrival_bits: NDArray[np.int64],
    ends: NDArray[np.int64],
    payload: Bytes,
) -> tuple[int, int, int, int]:
    """Parse the complete records at the start of ``raw``.

    Args:
        raw: Records; the last one may be incomplete.
        max_length: Maximum length of a record's payload [bytes]. A record with a longer one is damaged.
        arrival_bits: Output, shape (n,): arrival times as the bits of a float64.
        ends: Output, shape (n,): end of each record's bytes in ``payload``.
        payload: Output: concatenated bytes of the records.

    Returns:
        Number of parsed bytes, number of records, number of payload bytes, and 1 if the next record is damaged, otherwise 0.
    """
    position = records = payload_bytes = 0
    while records < ends.size:
        if raw.size - position < RECORD_OVERHEAD_BYTES:
            return position, records, payload_bytes, 0
        length = read_unsigned(raw, position + ARRIVAL_BYTES, LENGTH_BYTES)
        if length > max_length:
            return position, records, payload_bytes, 1
        body_begin = position + HEAD_BYTES
        body_end = body_begin + length
        if raw.size - body_end < CRC_BYTES:
            return position, records, payload_bytes, 0
        if crc16(raw, position, body_end) != read_unsigned(raw, body_end, CRC_BYTES):
            return position, records, payload_bytes, 1
        arrival_bits[records] = read_unsigned(raw, position, ARRIVAL_BYTES)
        payload[payload_bytes : payload_bytes + length] = raw[body_begin:body_end]
        payload_bytes += length
        ends[records] = payload_bytes
        records += 1
        position = body_end + CRC_BYTES
    return position, records, payload_bytes, 0
