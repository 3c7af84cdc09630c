"""Decoder from serial bytes to samples: COBS, CRC, sequence and clock (firmware/PROTOCOL.md).

One decoder serves the live line and the replay. Its state holds everything between calls, and the result does not
depend on how the bytes were divided into calls, except for the arrival time of the byte that ends a frame.

``d`` is the state of the decoder (a record of ``DECODER``), and ``s`` the scaling of the board (a record of ``SCALING``).
The tables in firmware/PROTOCOL.md give the offsets in a packet.
"""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import MAX_C, MIN_C, Record, Records, SampleStatus
from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.clock_drift import CLOCK_WINDOWS, add_arrival, reset_clock_estimate
from bms_estimator.protocols.firmware.messages import MODULUS, PROTOCOL_VERSION, BoardStatus, MessageType
from bms_estimator.protocols.firmware.scaling import (
    add_bandgap,
    add_ntc,
    current,
    reference,
    reset_readings,
    temperature,
    voltage,
)

Bytes = NDArray[np.uint8]

MESSAGE_SAMPLE = int(MessageType.SAMPLE)
MESSAGE_HELLO = int(MessageType.HELLO)
MESSAGE_ACK = int(MessageType.ACK)
SAMPLE_BYTES = 24
"""Length of a sample packet with its CRC [bytes]."""
HELLO_BYTES = 62
"""Length of a hello packet with its CRC [bytes]."""
ACK_BYTES = 10
"""Length of an acknowledgment packet with its CRC [bytes]."""
PACKET_BYTES = 64
"""Maximum length of a packet [bytes]."""
MIN_PACKET_BYTES = 4
"""Length of a packet without body: version, message type and CRC [bytes]."""
SAMPLE_FRAME_BYTES = SAMPLE_BYTES + 2
"""Length of a sample frame: the packet, one byte of COBS and the delimiter [bytes]."""

DECODER = np.dtype(
    [
        ("buffer", "u1", PACKET_BYTES + 2),  # incomplete frame, COBS-encoded
        ("packet", "u1", PACKET_BYTES + 2),  # last complete frame, decoded
        ("length", "i8"),  # bytes in the buffer
        ("overlong", "i8"),  # 1: the frame is too long and is skipped up to its end
        ("synchronized", "i8"),  # 1 once a delimiter was received, because earlier bytes may be half a frame
        ("started", "i8"),  # 1 after the first sample
        ("expected_sequence", "i8"),  # sequence of the next sample
        ("boot_id", "i8"),  # boot id of the last hello; -1: none since a reset, or since another board may be connected
        ("serial", "i8"),  # serial number of the last hello
        ("period_us", "f8"),  # sample period of the last hello [us]
        ("doubted_s", "f8"),  # arrival time at which boot_id became -1 [s]
        ("withheld_status", "i8"),  # status bits of samples that were dropped since doubted_s
        ("reset_pending", "i8"),  # 1 from a hello that reported a reset until the next sample
        ("board_us", "i8"),  # board clock of the last sample, 32 bit [us]
        ("elapsed_us", "i8"),  # board clock since the first sample or the reset, without wraps [us]
        ("origin_s", "f8"),  # sample time at which elapsed_us was 0 [s]
        ("time_s", "f8"),  # time of the last sample since the first one [s]
        ("arrival_s", "f8"),  # arrival time of the last sample [s]
        ("min_delay_s", "f8"),  # smallest recent delay: arrival time minus sample time [s]
        ("clock_windows", "i8"),  # number of windows of the clock estimate since the first sample or the reset
        ("clock_begin_us", "i8"),  # elapsed_us at the beginning of the last window
        ("clock_origin_s", "f8"),  # arrival time that is the origin of the delays
        ("clock_at_us", "i8", CLOCK_WINDOWS),  # elapsed_us of the sample with the smallest delay in each window
        ("clock_late_s", "f8", CLOCK_WINDOWS),  # delay of the sample with the smallest delay in each window [s]
        ("current_sign", "f8"),  # 1 if the board's positive current is a discharge, otherwise -1
        ("bytes_received", "i8"),
        ("last_frame_end", "i8"),  # bytes_received at the end of the last frame with a right CRC
        ("frames_received", "i8"),  # decoded samples
        ("frames_lost", "i8"),
        ("cobs_errors", "i8"),
        ("length_errors", "i8"),
        ("crc_errors", "i8"),
        ("version_errors", "i8"),
        ("type_errors", "i8"),
        ("duplicates", "i8"),
        ("out_of_order", "i8"),
        ("before_hello", "i8"),
        ("overruns", "i8"),
        ("resets", "i8"),
        ("implausible", "i8"),  # implausible temperatures
        ("clock_jumps", "i8"),  # restarts of the board's clock from the arrival time
    ],
    align=True,
)

_MASK = MODULUS - 1
_HALF = MODULUS >> 1
MAX_LEAD_S = 2.0
"""Maximum time by which a sample's delay may fall below the smallest one [s]. More shows a wrong board clock."""
MAX_ADVANCE_S = 0.3
"""Maximum advance of the board's clock between two samples beyond arrival times and sequence numbers [s]."""
MAX_SLOWNESS = 0.01
"""Maximum relative amount by which a board's clock is slower than the host's."""
_REORDER_WINDOW = 64  # in samples; a sample further behind belongs to a board whose clock restarted
_MAX_MISMATCH = 0.1
"""Maximum relative difference between the sequence and the clock of a board. More shows another board or sample rate."""
MAX_DOUBT_S = 5.0
"""Maximum time for which samples are dropped until a hello identifies their board [s]. Then they are accepted."""
_US = 1e-6
_WRAP_S = MODULUS * _US

_OVERRUN = int(BoardStatus.OVERRUN)
_SATURATED_OR_OVERRUN = int(BoardStatus.VOLTAGE_SATURATED | BoardStatus.CURRENT_SATURATED | BoardStatus.OVERRUN)
"""Status bits that are equal in frames and in SampleStatus."""
_AUX_IS_NTC = int(BoardStatus.AUX_IS_NTC)
_RESET = int(SampleStatus.RESET)
_GAP = int(SampleStatus.GAP)


def _crc_table() -> NDArray[np.uint16]:
    table = np.zeros(256, dtype=np.uint16)
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        table[byte] = crc & 0xFFFF
    return table


CRC_TABLE = _crc_table()


@njit(cache=True)
def crc16(data: Bytes, begin: int, end: int) -> int:
    """Return the CRC-16/CCITT-FALSE of ``data[begin:end]``."""
    crc = 0xFFFF
    for i in range(begin, end):
        crc = ((crc << 8) & 0xFFFF) ^ int(CRC_TABLE[(crc >> 8) ^ int(data[i])])
    return crc


@njit(cache=True)
def cobs_decode(frame: Bytes, length: int, packet: Bytes) -> int:
    """Decode ``frame[:length]``, free of zeros, into ``packet``. Return its length, or -1 if it is not COBS."""
    i = n = 0
    while i < length:
        block_end = i + int(frame[i])
        if block_end > length:
            return -1
        i += 1
        while i < block_end:
            packet[n] = frame[i]
            n += 1
            i += 1
        if i < length:  # packets are shorter than 254 bytes, so that each block but the last stands for a zero
            packet[n] = 0
            n += 1
    return n


@njit(cache=True)
def read_unsigned(packet: Bytes, offset: int, size: int) -> int:
    """Read an unsigned little-endian number."""
    value = 0
    for i in range(size):
        value |= int(packet[offset + i]) << (8 * i)
    return value


@njit(cache=True)
def unpack_frame(d: Record) -> int:  # noqa: PLR0911 - one return for each fault
    """Unpack the buffered frame into ``packet``. Return its message type, or 0 if it is invalid. Count faults by kind."""
    counted = d.synchronized  # an incomplete frame before the first delimiter is no fault
    if d.overlong:
        d.length_errors += counted
        return 0
    packet = d.packet
    length = cobs_decode(d.buffer, d.length, packet)
    if length < 0:
        d.cobs_errors += counted
        return 0
    if length < MIN_PACKET_BYTES:
        d.length_errors += counted
        return 0
    if crc16(packet, 0, length - 2) != read_unsigned(packet, length - 2, 2):
        d.crc_errors += counted
        return 0
    d.last_frame_end = d.bytes_received
    if packet[0] != PROTOCOL_VERSION:
        d.version_errors += 1
        return 0
    message_type = int(packet[1])
    if message_type == MESSAGE_SAMPLE:
        expected_length = SAMPLE_BYTES
    elif message_type == MESSAGE_HELLO:
        expected_length = HELLO_BYTES
    elif message_type == MESSAGE_ACK:
        expected_length = ACK_BYTES
    else:
        d.type_errors += 1
        return 0
    if length != expected_length:
        d.length_errors += 1
        return 0
    return message_type


@njit(cache=True)
def apply_hello(d: Record, s: Record) -> None:
    """Store the board's scaling, and detect a reset or another board."""
    p = d.packet
    boot_id, serial = read_unsigned(p, 6, 2), read_unsigned(p, 8, 4)
    is_new = boot_id != d.boot_id or serial != d.serial
    is_behind = (read_unsigned(p, 12, 4) - d.expected_sequence) & _MASK >= _HALF  # the sequence restarted
    if d.started and (is_behind or (d.boot_id >= 0 and is_new)):
        d.reset_pending = 1
    if is_new:
        reset_readings(s)
    d.boot_id, d.serial = boot_id, serial
    d.period_us = read_unsigned(p, 22, 4) * 1e-3
    s.full_scale = float(
        1 << min(read_unsigned(p, 26, 1), 24)
    )  # an implausible number of bits must not overflow the shift
    channels = read_unsigned(p, 27, 1)
    s.ntc_fitted = channels & 1
    s.ratiometric = channels >> 1 & 1
    s.divider = read_unsigned(p, 28, 4) * 1e-6
    s.volts_per_ampere = read_unsigned(p, 32, 4) * 1e-6
    s.current_zero = read_unsigned(p, 36, 4) * 1e-6
    s.bandgap_v = read_unsigned(p, 40, 4) * 1e-6
    if s.bandgap_weight == 0.0 and read_unsigned(p, 48, 2) > 0:
        add_bandgap(s, float(read_unsigned(p, 44, 4)), float(read_unsigned(p, 48, 2)), read_unsigned(p, 16, 4))
    s.ntc_series_ohm = float(read_unsigned(p, 50, 4))
    s.ntc_r25_ohm = float(read_unsigned(p, 54, 4))
    s.ntc_beta_k = float(read_unsigned(p, 58, 2))
    s.known = 1


@njit(cache=True)
def is_early(d: Record, arrival_s: float, time_s: float) -> bool:
    """Return True if the sample of ``time_s`` arrived more than ``MAX_LEAD_S`` earlier than the smallest delay allows."""
    return bool(arrival_s - time_s < d.min_delay_s - MAX_LEAD_S)


@njit(cache=True)
def is_consistent_with_clock(d: Record, samples: int, step_us: int) -> bool:
    """Return True if the number of samples fits the time step of the board's clock."""
    mismatch_us = abs(samples * d.period_us - step_us)
    return mismatch_us <= max(_MAX_MISMATCH * step_us, _REORDER_WINDOW * d.period_us)


@njit(cache=True)
def advance_clock(d: Record, board_us: int, arrival_s: float, lost: int) -> bool:
    """Advance the time by the board's clock. The arrival time shows wraps of its 32 bits during an outage.

    Returns:
        True if the step is plausible: the sample is not early, and the number of lost samples fits the step. Delayed
        samples arrive together, at most one period apart by the board's clock. A clock that is steadily too fast, as in
        simulations, is detected by its rate and not here.
    """
    step_us = (board_us - d.board_us) & _MASK
    if lost > 0:
        wraps = round((arrival_s - d.arrival_s - step_us * _US) / _WRAP_S)
        step_us += max(wraps, 0) * MODULUS
    time_s = d.origin_s + (d.elapsed_us + step_us) * _US
    # advance of the board's clock that neither the sequence numbers nor the arrival times explain
    excess_s = (step_us - (lost + 1) * d.period_us) * _US - (arrival_s - d.arrival_s)
    if (
        excess_s > MAX_ADVANCE_S
        or is_early(d, arrival_s, time_s)
        or (lost > 0 and not is_consistent_with_clock(d, lost + 1, step_us))
    ):
        return False
    d.min_delay_s = min(d.min_delay_s + MAX_SLOWNESS * step_us * _US, arrival_s - time_s)
    d.elapsed_us += step_us
    d.time_s = time_s
    return True


@njit(cache=True)
def restart_clock(d: Record, arrival_s: float, min_advance_s: float) -> None:
    """Restart the board's clock: continue by arrival time, advancing by at least ``min_advance_s``."""
    d.origin_s = d.time_s + max(arrival_s - d.arrival_s, min_advance_s)
    d.time_s = d.origin_s
    d.elapsed_us = 0
    d.min_delay_s = arrival_s - d.origin_s
    reset_clock_estimate(d)


@njit(cache=True)
def require_new_hello(d: Record, arrival_s: float) -> None:
    """Drop samples until the next hello, because another board with another scaling may be connected."""
    d.boot_id = -1
    d.doubted_s = arrival_s


@njit(cache=True)
def check_sequence(d: Record, sequence: int, board_us: int, arrival_s: float) -> int:
    """Check the sequence number of a sample. Return bits of SampleStatus, or -1 if the sample must be dropped."""
    status = 0
    if not d.started:
        d.started = 1
        d.min_delay_s = arrival_s - d.origin_s
    else:
        ahead = (sequence - d.expected_sequence) & _MASK
        behind = MODULUS - ahead if ahead >= _HALF else 0
        if d.reset_pending or behind > _REORDER_WINDOW:
            if not d.reset_pending:
                require_new_hello(d, arrival_s)  # the hello after the reset was lost; the next one is not a reset
            uptime_s = board_us * _US  # time since the reset
            if is_early(d, arrival_s, d.time_s + uptime_s):  # implausible, so that the arrival time alone counts
                uptime_s = 0.0
                d.clock_jumps += 1
            restart_clock(d, arrival_s, uptime_s)
            d.reset_pending = 0
            d.resets += 1
            status = _RESET
        elif behind == 1:
            d.duplicates += 1
            return -1
        elif behind > 1:
            d.out_of_order += 1
            return -1
        else:
            if not advance_clock(d, board_us, arrival_s, ahead):
                restart_clock(d, arrival_s, 0.0)
                d.clock_jumps += 1
                require_new_hello(d, arrival_s)
            d.frames_lost += ahead
            status = _GAP if ahead else 0
    d.expected_sequence = (sequence + 1) & _MASK
    d.board_us = board_us
    d.arrival_s = arrival_s
    add_arrival(d, arrival_s)
    return status


@njit(cache=True)
def decode_sample(d: Record, s: Record, arrival_s: float, out: Record) -> int:
    """Decode a sample packet into ``out``. Return 1, or 0 if the sample is dropped."""
    p = d.packet
    if not s.known:
        d.before_hello += 1
        return 0
    status = check_sequence(d, read_unsigned(p, 2, 4), read_unsigned(p, 6, 4), arrival_s)
    if status < 0:
        return 0
    if d.boot_id < 0 and arrival_s - d.doubted_s < MAX_DOUBT_S:
        d.withheld_status |= status
        d.before_hello += 1
        return 0
    status |= d.withheld_status
    d.withheld_status = 0
    d.frames_received += 1
    status_bits = int(p[21])
    aux_count = float(p[20])
    if aux_count > 0.0:
        if status_bits & _AUX_IS_NTC:
            add_ntc(s, float(read_unsigned(p, 18, 2)), aux_count, d.board_us)
        else:
            add_bandgap(s, float(read_unsigned(p, 18, 2)), aux_count, d.board_us)
    if status_bits & _OVERRUN:
        d.overruns += 1
    count = float(read_unsigned(p, 16, 2))
    reference_v = reference(s)
    out.time_s = d.time_s
    out.voltage_v = voltage(s, float(read_unsigned(p, 10, 3)), count, reference_v)
    out.current_a = d.current_sign * current(s, float(read_unsigned(p, 13, 3)), count, reference_v)
    out.temperature_c = temperature(s)
    if out.temperature_c < MIN_C or out.temperature_c > MAX_C:
        out.temperature_c = math.nan
        d.implausible += 1
    out.temperature_min_c = out.temperature_max_c = out.temperature_c
    out.status = status | (status_bits & _SATURATED_OR_OVERRUN)
    return 1


@njit(cache=True)
def decode(
    data: Bytes,
    begin: int,
    ends: NDArray[np.int64],
    arrivals_s: NDArray[np.float64],
    decoder: Records,
    scaling: Records,
    samples: Records,
    messages: NDArray[np.uint8],
) -> tuple[int, int, int]:
    """Decode ``data[begin:]`` until it ends or an output is full.

    Args:
        data: Bytes of one or more reads of the line.
        begin: Start index, 0 at first.
        ends: Shape (reads,): end of each read in ``data``, increasing; the last is ``data.size``.
        arrivals_s: Shape (reads,): arrival time of each read.
        decoder: Shape (1,), dtype DECODER; updated.
        scaling: Shape (1,), dtype SCALING; updated.
        samples: Output, dtype SAMPLE.
        messages: Output, shape (n, PACKET_BYTES): packets other than samples, padded with zeros.

    Returns:
        Start index of the next call, number of samples written, number of messages written.
    """
    d, s = decoder[0], scaling[0]
    buffer = d.buffer
    length = d.length
    n_samples = n_messages = 0
    read = np.searchsorted(ends, begin, side="right")
    i = counted = begin
    while i < data.size and n_samples < samples.size and n_messages < messages.shape[0]:
        byte = data[i]
        i += 1
        if byte != 0:  # zero is the delimiter of COBS frames
            if length < buffer.size:
                buffer[length] = byte
                length += 1
            else:
                d.overlong = 1
            continue
        d.bytes_received += i - counted
        counted = i
        if length > 0:
            d.length = length
            message_type = unpack_frame(d)
            if message_type == MESSAGE_SAMPLE:
                while ends[read] < i:
                    read += 1
                n_samples += decode_sample(d, s, arrivals_s[read], samples[n_samples])
            elif message_type != 0:
                if message_type == MESSAGE_HELLO:
                    apply_hello(d, s)
                for j in range(PACKET_BYTES):
                    messages[n_messages, j] = d.packet[j]
                messages[n_messages, HELLO_BYTES if message_type == MESSAGE_HELLO else ACK_BYTES :] = 0
                n_messages += 1
        d.synchronized = 1
        d.overlong = 0
        length = 0
    d.length = length
    d.bytes_received += i - counted
    return i, n_samples, n_messages
