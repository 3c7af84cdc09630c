"""Foreign text to numbers: decimal ones and nothing else."""

import math
import re

PRINTABLE = b"\t\r\n" + bytes(range(0x20, 0x7F))
"""Bytes of printed lines."""

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""A decimal number. Python's ``float`` also takes ``3_9`` for 39, other scripts' digits, ``nan`` and ``inf``."""
NOT_MEASURED = frozenset({"nan", "inf", "infinity", "ovf"})
"""Words that programs print in place of a number, perhaps with a sign."""

_WHOLE = re.compile(NUMBER)


def number(text: str) -> float:
    """Parse a number in ``text``, with blanks around it allowed.

    Raises:
        ValueError: It is not a number, or too large.
    """
    text = text.strip(" \t\r\n")
    if not _WHOLE.fullmatch(text) or not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:40]!r}: no decimal number")
    return value


def measured(text: str) -> float:
    """Parse a number as ``number`` does; NaN for a word that means a missing value.

    Raises:
        ValueError: It is neither.
    """
    return math.nan if text.strip().lstrip("+-").lower() in NOT_MEASURED else number(text)
