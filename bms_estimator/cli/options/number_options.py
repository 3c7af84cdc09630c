"""Parsers of numeric options, as strict as the parsers of settings. Python itself would parse ``3_9`` as 39."""

import math
import re
from collections.abc import Callable
from typing import TypeVar

import typer

from bms_estimator.model.decimal_text import number as parse_decimal

Number = TypeVar("Number", int, float)


def decimal(minimum: float = -math.inf, maximum: float = math.inf) -> Callable[[str | float], float]:
    """Return a parser of a decimal number within limits."""
    return _limited(parse_decimal, minimum, maximum)


def whole(minimum: float = -math.inf, maximum: float = math.inf) -> Callable[[str | int], int]:
    """Return a parser of an integer within limits."""
    return _limited(_parse_integer, minimum, maximum)


def _parse_integer(text: str) -> int:
    """Parse an integer.

    Raises:
        ValueError: The text is not an integer.
    """
    if not re.fullmatch("[-+]?[0-9]+", text):
        raise ValueError(f"{text[:40]!r}: not an integer")
    return int(text)


def _limited(parse: Callable[[str], Number], minimum: float, maximum: float) -> Callable[[str | Number], Number]:
    """Return a parser that also checks the limits of the number."""

    def parse_and_check(text: str | Number) -> Number:
        if not isinstance(text, str):  # typer also passes the option's default, which is a number
            return text
        try:
            value = parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
        if not minimum <= value <= maximum:
            bounds = {"at least": minimum, "at most": maximum}
            limits = [f"{name} {bound:.12g}" for name, bound in bounds.items() if math.isfinite(bound)]
            raise typer.BadParameter(f"{text}: must be {' and '.join(limits)}")
        return value

    return parse_and_check
