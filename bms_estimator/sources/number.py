"""Foreign text to numbers: decimal ones and nothing else, and which of them a sensor on a pack may say."""

import math
import re

import numpy as np
from numpy.typing import NDArray

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""A decimal number. Python's ``float`` also takes ``3_9`` for 39, other scripts' digits, ``nan`` and ``inf``."""
NOT_MEASURED = frozenset({"nan", "inf", "infinity", "ovf"})
"""What programs print, perhaps with a sign, where there is no number."""
LEAST_C, MOST_C = -60.0, 200.0
"""No sensor on a pack or a stack says anything beyond [degC]."""
LEAST_CELL_V, MOST_CELL_V = -5.0, 10.0
"""No single cell has a voltage beyond, be it reversed [V]."""

_WHOLE = re.compile(NUMBER)


def number(text: str) -> float:
    """The number that ``text``, apart from blanks around it, is.

    Raises:
        ValueError: It is none, or one that is too large to be held.
    """
    text = text.strip(" \t\r\n")
    if not _WHOLE.fullmatch(text) or not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:40]!r}: no decimal number")
    return value


def measured(text: str) -> float:
    """As ``number``; NaN where ``text`` is a word for there being none.

    Raises:
        ValueError: It is neither.
    """
    return math.nan if text.strip().lstrip("+-").lower() in NOT_MEASURED else number(text)


def forget_beyond(values: NDArray[np.float64], least: float, most: float) -> int:
    """Make NaN, in place, what is outside ``least``..``most``. Returns how many there were."""
    beyond = (values < least) | (values > most)
    values[beyond] = math.nan
    return int(np.count_nonzero(beyond))
