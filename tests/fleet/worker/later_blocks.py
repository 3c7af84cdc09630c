"""Program that reads blocks of a later version; the arguments are those of ``bms-estimator``."""

from bms_estimator.edge import block

VERSION = 4
"""Version of the blocks."""
VERSION_OFFSET = 4
"""Offset of the version in a block [bytes]."""


def later_block(data: bytes) -> bytes:
    """Return a block as one of the later version."""
    return data[:VERSION_OFFSET] + bytes([VERSION]) + data[VERSION_OFFSET + 1 :]


if __name__ == "__main__":
    block.VERSION = VERSION
    from bms_estimator.cli.main import main

    main()
