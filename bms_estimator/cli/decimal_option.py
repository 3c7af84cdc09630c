"""Decimal numbers among the options: what the settings take as a number, and nothing else."""

import math
from collections.abc import Callable

import typer

from bms_estimator.sources.number import number


def decimal(least: float = -math.inf, most: float = math.inf) -> Callable[[str | float], float]:
    """Parser of an option. Python's own takes ``3_9`` for 39, ``nan`` and ``inf``.

    Args:
        least: The option must not be less.
        most: Nor more.
    """

    def parse(text: str | float) -> float:
        if isinstance(text, float):  # a default
            return text
        try:
            value = number(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
        if not least <= value <= most:
            bounds = {"at least": least, "at most": most}
            limits = [f"{name} {bound:g}" for name, bound in bounds.items() if math.isfinite(bound)]
            raise typer.BadParameter(f"{text}: must be {' and '.join(limits)}")
        return value

    return parse
