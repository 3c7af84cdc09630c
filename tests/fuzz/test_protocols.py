"""Device protocols that decode edited bytes raise no exception and count no more bytes than were received."""

import contextlib

import numpy as np
from hypothesis import strategies as st

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.protocols.base.reading_protocol import DeviceProtocol
from bms_estimator.protocols.devices import daly, jbd, jk
from bms_estimator.protocols.devices.junctek import JunctekProtocol
from bms_estimator.protocols.devices.pylontech import PylontechProtocol
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.protocols.devices.vedirect import VeDirectProtocol
from bms_estimator.protocols.firmware.messages import DELIMITER, Ack, Hello, ProtocolError, SampleMessage, seal, unseal
from bms_estimator.protocols.firmware.protocol import BoardProtocol
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from tests.fuzz.edited_seeds import edit, edited_seeds, load_seeds

PACKETS = [unseal(frame) for data in load_seeds("frames") for frame in data.split(DELIMITER) if frame]
VERSION_AND_HELLO, VERSION_AND_SAMPLE = b"\x01\x01", b"\x01\x02"
"""Beginnings of packets: protocol version and message type."""
EDITED_PACKETS = edit(PACKETS, (VERSION_AND_HELLO, VERSION_AND_SAMPLE))
FRAMES = st.lists((st.sampled_from(PACKETS) | EDITED_PACKETS).map(seal), min_size=1, max_size=6).map(b"".join)

LFP = Estimator(load_cell("lfp", 100.0).pack(4, 1))


def decode(protocol: DeviceProtocol, data: bytes) -> None:
    """Feed ``data`` in two chunks, and again in one chunk after the port was reopened. Use all results."""
    middle = len(data) // 2
    protocol.feed(1.0, data[:middle])
    protocol.next_output(1.5)
    protocol.feed(2.0, data[middle:])
    protocol.on_port_opened()
    protocol.serial_number_in(data)
    protocol.next_output(2.5)
    protocol.feed(3.0, data)
    protocol.next_output(3.5)
    assert protocol.counters["bytes_received"] <= 2 * len(data)
    # Properties may compute their value, so that they could raise an exception, too.
    _ = (
        protocol.fault,
        protocol.description,
        protocol.board,
        protocol.clock_ppm,
        protocol.clock_fault,
        protocol.allowed_silence_s,
    )


def decode_responses(name: str, data: bytes) -> None:
    """Decode ``data`` as responses of a BMS."""
    protocol = make_protocol(SensorSettings.model_validate({"protocol": name}))
    decode(protocol, data)
    assert protocol.counters["noise_bytes"] <= protocol.counters["bytes_received"] == 2 * len(data)


def with_vedirect_checksums(data: bytes) -> bytes:
    """Correct the checksum of each block."""
    first, *others = data.split(b"\r\nChecksum\t")
    blocks = [block + b"\r\nChecksum\t" for block in (first, *(other[1:] for other in others))]
    return b"".join(block + bytes((-sum(block) & 0xFF,)) for block in blocks)


def with_junctek_checksums(data: bytes) -> bytes:
    """Correct the checksum of each line."""
    lines = []
    for line in data.split(b"\n"):
        head, *values = line.strip().split(b",")
        # Longer numbers are rejected anyway, and ``int`` raises an exception for very long ones.
        numbers = [int(value) for value in values[1:] if value.isdigit() and len(value) < 20]
        lines.append(b",".join([head, b"%d" % (sum(numbers) % 255 + 1), *values[1:]]))
    return b"\n".join(lines)


def with_jbd_checksums(data: bytes) -> bytes:
    """Correct checksum and end mark of each frame. Its fourth byte is the length of its content."""
    begin = data.find(b"\xdd")
    while 0 <= begin < len(data) - 4:
        end = begin + 4 + data[begin + 3]
        data = data[:end] + jbd.checksum(data[begin + 2 : end]) + b"\x77" + data[end + 3 :]
        begin = data.find(b"\xdd", end)
    return data


def with_daly_checksums(data: bytes) -> bytes:
    """Correct the checksum of each frame: a start byte, eleven others, and the checksum."""
    first, *frames = data.split(b"\xa5")
    return first + b"".join(daly.with_checksum(b"\xa5" + frame[:11].ljust(11, b"\0")) + frame[12:] for frame in frames)


def with_jk_checksum(data: bytes) -> bytes:
    """Correct the first frame of the PB series (299 bytes and a checksum), or else length and checksum of an older frame."""
    begin = data.find(jk.START)
    if begin >= 0:
        frame = data[begin : begin + 299].ljust(299, b"\0")
        return data[:begin] + frame + bytes((sum(frame) & 0xFF,)) + data[begin + 300 :]
    before, start, body = data.partition(jk.OLD_START)
    body = body[2:482]  # without the length, which counts itself, an end byte and the checksum as well
    return before + jk.with_old_checksum(start + (len(body) + 7).to_bytes(2, "big") + body + bytes((jk.OLD_END,)))


@edited_seeds("frames", DELIMITER, VERSION_AND_HELLO, VERSION_AND_SAMPLE, b"\xff\xff\xff\xff", others=FRAMES)
def test_board_protocol_decodes_edited_frames(data: bytes) -> None:
    decode(BoardProtocol(rate_hz=100), data)


@edited_seeds("messages", DELIMITER, VERSION_AND_SAMPLE, others=EDITED_PACKETS.map(seal))
def test_message_decoders_raise_only_protocol_errors(data: bytes) -> None:
    for decode_message in (Hello.decode, Ack.decode, SampleMessage.decode):
        with contextlib.suppress(ProtocolError):
            decode_message(unseal(data))


@edited_seeds("text", b"V=", b"I=", b"T=", b"cells=", b'{"voltage":', b";", b" mA", b"kV")
def test_text_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode(TextProtocol(), data)
    decoder, alarms = TextProtocol(), AlarmEvaluator(Settings(), LFP)
    samples = decoder.feed(0.0, data)
    alarms.evaluate(samples, np.zeros(0, TRACE), CellSlots(4).select(decoder.cells), arrival_s=1.7e9)
    alarms.changes()


@edited_seeds("vedirect", b"\r\nV\t", b"\r\nI\t", b"\r\nChecksum\t", b":7F0", repair=with_vedirect_checksums)
def test_vedirect_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode(VeDirectProtocol(), data)


@edited_seeds("junctek", b":r50=1,", b",", b":R50=1,2,1,\r\n", repair=with_junctek_checksums)
def test_junctek_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode(JunctekProtocol(), data)


@edited_seeds("pylontech", b"pylon>", b"Power Volt", b"Absent", b"bat 2", b" - ")
def test_pylontech_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode(PylontechProtocol(), data)


@edited_seeds("jbd", b"\xdd\x03\0", b"\xdd\x04\0", b"\x77", repair=with_jbd_checksums)
def test_jbd_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode_responses("jbd", data)


@edited_seeds("daly", b"\xa5\x01\x90\x08", b"\xa5\x01\x95\x08", repair=with_daly_checksums)
def test_daly_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode_responses("daly", data)


@edited_seeds("jk", jk.OLD_START, jk.START, jk.START + b"\x02", b"\xc0\x01", b"\x79", repair=with_jk_checksum)
def test_jk_protocol_decodes_edited_bytes(data: bytes) -> None:
    decode_responses("jk", data)
