"""Numbers among the options: what the settings take as a number, and nothing else. Python's own takes ``3_9`` for 39."""

import math
import re
from collections.abc import Callable
from typing import TypeVar

import typer

from bms_estimator.model.decimal_text import number

Number = TypeVar("Number", int, float)


def decimal(least: float = -math.inf, most: float = math.inf) -> Callable[[str | float], float]:
    """Parser of an option.

    Args:
        least: The option must not be less.
        most: Nor more.
    """
    return _within(number, least, most)


def whole(least: float = -math.inf, most: float = math.inf) -> Callable[[str | int], int]:
    """Return a parser of an integer within limits."""
    return _within(_whole, least, most)


def _whole(text: str) -> int:
    """Parse an integer.

    Raises:
        ValueError: It is not a number.
    """
    if not re.fullmatch("[-+]?[0-9]+", text):
        raise ValueError(f"{text[:40]!r}: no whole number")
    return int(text)


def _within(parse: Callable[[str], Number], least: float, most: float) -> Callable[[str | Number], Number]:
    def parse_and_check(text: str | Number) -> Number:
        if not isinstance(text, str):  # a default
            return text
        try:
            value = parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
        if not least <= value <= most:
            bounds = {"at least": least, "at most": most}
            limits = [f"{name} {bound:.12g}" for name, bound in bounds.items() if math.isfinite(bound)]
            raise typer.BadParameter(f"{text}: must be {' and '.join(limits)}")
        return value

    return parse_and_check
