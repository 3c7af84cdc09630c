"""Checksum in the first line of a file, so that any damage is recognized."""

import zlib

CHECKSUM_BYTES = 9
"""Length of the first line [bytes]."""


def add_checksum(body: bytes) -> bytes:
    """Return ``body`` after a line with its CRC-32."""
    return b"%08x\n%b" % (zlib.crc32(body), body)


def verify_checksum(content: bytes) -> bytes:
    """Return the body of a file that ``add_checksum`` made.

    Raises:
        ValueError: The file is damaged.
    """
    line, _, body = content.partition(b"\n")
    if line != b"%08x" % zlib.crc32(body):
        raise ValueError("its checksum is wrong")
    return body
