"""Fast encoder of the frames of a board, for millions of samples."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.framing import MESSAGE_SAMPLE, SAMPLE_BYTES, SAMPLE_FRAME_BYTES, crc16
from bms_estimator.protocols.firmware.messages import PROTOCOL_VERSION, Hello

REFERENCE_V, FULL_SCALE, DIVIDER, VOLTS_PER_AMPERE, BANDGAP_V = 5.0, 1024, 5.0, 0.1, 1.1
BANDGAP_READINGS = 256
"""Number of bandgap readings whose sum the hello reports."""
CONVERSIONS = 16
"""Number of conversion pairs in the window of a sample."""


def hello(rate_hz: int) -> bytes:
    """Return the hello message of a board that sends ``sample_frames``."""
    return Hello(
        firmware_major=1,
        firmware_minor=0,
        firmware_patch=0,
        reset_cause=1,
        boot_id=1,
        serial=1,
        sequence=0,
        board_us=0,
        rate_hz=rate_hz,
        period_ns=1_000_000_000 // rate_hz,
        adc_bits=10,
        channels=0,
        divider_ppm=round(DIVIDER * 1e6),
        current_uv_per_a=round(VOLTS_PER_AMPERE * 1e6),
        current_zero_ppm=500_000,
        bandgap_uv=round(BANDGAP_V * 1e6),
        bandgap_sum=round(BANDGAP_V / REFERENCE_V * FULL_SCALE * BANDGAP_READINGS),
        bandgap_count=BANDGAP_READINGS,
        ntc_series_ohm=10_000,
        ntc_r25_ohm=10_000,
        ntc_beta_k=3950,
    ).encode()


def sample_frames(block: SampleBlock, first: int = 0) -> NDArray[np.uint8]:
    """Return the frames of samples.

    Args:
        block: Shape (n,), dtype SAMPLE.
        first: Sequence number of the first sample.

    Returns:
        Shape (n, SAMPLE_FRAME_BYTES).
    """
    pin_v = block["voltage_v"] / DIVIDER
    sensor_v = 0.5 * REFERENCE_V + VOLTS_PER_AMPERE * block["current_a"]
    sums = [np.rint(v / REFERENCE_V * FULL_SCALE * CONVERSIONS).astype(np.int64) for v in (pin_v, sensor_v)]
    return _frames(np.rint(block["time_s"] * 1e6).astype(np.int64), sums[0], sums[1], first)


@njit(cache=True)
def _put(packet, offset, size, value):
    """Write an unsigned integer, little-endian."""
    for i in range(size):
        packet[offset + i] = (value >> (8 * i)) & 0xFF


@njit(cache=True)
def _frames(board_us, voltage_sum, current_sum, first):
    frames = np.zeros((board_us.size, SAMPLE_FRAME_BYTES), dtype=np.uint8)
    packet = np.zeros(SAMPLE_BYTES, dtype=np.uint8)
    packet[0], packet[1] = PROTOCOL_VERSION, MESSAGE_SAMPLE
    for j in range(board_us.size):
        _put(packet, 2, 4, first + j)
        _put(packet, 6, 4, board_us[j])
        _put(packet, 10, 3, voltage_sum[j])
        _put(packet, 13, 3, current_sum[j])
        _put(packet, 16, 2, CONVERSIONS)
        _put(packet, SAMPLE_BYTES - 2, 2, crc16(packet, 0, SAMPLE_BYTES - 2))
        code = 0  # position of the last COBS code: each zero is replaced by the distance to the next zero
        for i in range(SAMPLE_BYTES):
            if packet[i] == 0:
                frames[j, code] = i + 1 - code
                code = i + 1
            else:
                frames[j, i + 1] = packet[i]
        frames[j, code] = SAMPLE_BYTES + 1 - code
    return frames
