"""Strict parser of decimal numbers in text from devices and files."""

import math
import re

PRINTABLE = b"\t\r\n" + bytes(range(0x20, 0x7F))
"""Bytes allowed in lines of text: printable ASCII, tab, and line ends."""

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""Pattern of a decimal number. Python's ``float`` would also accept ``3_9``, digits of other scripts, ``nan`` and ``inf``."""
NOT_MEASURED = frozenset({"nan", "inf", "infinity", "ovf"})
"""Words that devices print for a missing value, with an optional sign."""

_NUMBER = re.compile(NUMBER)


def number(text: str) -> float:
    """Parse a decimal number with optional white space around it.

    Raises:
        ValueError: The text is not a decimal number, or the number is too large.
    """
    text = text.strip(" \t\r\n")
    if not _NUMBER.fullmatch(text) or not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:40]!r}: no decimal number")
    return value


def measured(text: str) -> float:
    """Parse a decimal number, or a word of ``NOT_MEASURED`` as NaN.

    Raises:
        ValueError: The text is neither.
    """
    return math.nan if text.strip().lstrip("+-").lower() in NOT_MEASURED else number(text)
