"""Packets of MQTT 3.1.1."""

import struct
from enum import IntEnum


class Packet(IntEnum):
    """First byte of an MQTT packet, without flags."""

    CONNECT, CONNACK, PUBLISH, PUBACK = 0x10, 0x20, 0x30, 0x40
    SUBSCRIBE, SUBACK, PINGREQ, PINGRESP = 0x82, 0x90, 0xC0, 0xD0


def text(data: bytes) -> bytes:
    """Return a text with its length."""
    return struct.pack(">H", len(data)) + data


def packet(kind: int, body: bytes) -> bytes:
    """Return a packet; its length is encoded in groups of seven bits."""
    length, rest = bytearray(), len(body)
    while True:
        rest, digit = rest >> 7, rest & 0x7F
        length.append(digit | (0x80 if rest else 0))
        if not rest:
            return bytes([kind]) + bytes(length) + body


def next_packet(received: bytearray) -> tuple[int, bytes] | None:
    """Remove the first packet from the received bytes and return kind and body; None if it is incomplete."""
    length, position = 0, 1
    while position < len(received):
        digit = received[position]
        length |= (digit & 0x7F) << (7 * (position - 1))
        position += 1
        if not digit & 0x80:
            break
    else:
        return None
    if len(received) < position + length:
        return None
    kind, body = received[0], bytes(received[position : position + length])
    del received[: position + length]
    return kind, body
