"""Which parameters a load tells: verdicts from the covariance of the estimates (inverse Fisher information)."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.elements import NAMES

Floats = NDArray[np.float64]

IDENTIFIED_STD, WEAK_STD = 0.15, 0.4
"""Greatest relative standard errors of an identified and of a weakly identified parameter. With no information at all
it is 0.7 or more: that of the cell file."""


class Verdict(StrEnum):
    """What a load says of a parameter."""

    IDENTIFIED = "identified"
    WEAK = "weak"
    NOT_TOLD = "not told by this load"


@dataclass(frozen=True)
class Parameter:
    """One of a1..a15.

    Attributes:
        name: ``a1`` to ``a15``.
        value: In the unit of the thesis [ohm, 1, F].
        std: Its standard error, same unit.
        verdict: What the load says of it.
        leans_on: The parameter whose estimate goes with this one most.
        correlation: Of the two, -1..1.
        at_limit: It stands at the limit of the search: take the value as "at most" or "at least".
    """

    name: str
    value: float
    std: float
    verdict: Verdict
    leans_on: str
    correlation: float
    at_limit: bool

    @property
    def relative_std(self) -> float:
        """Standard error in parts of the value."""
        return self.std / self.value


def parameters(a: Floats, std: Floats, correlation: Floats, at_limit: NDArray[np.bool_]) -> tuple[Parameter, ...]:
    """a1..a15 with their verdicts.

    Args:
        a: a1..a15 at index 1..15.
        std: Shape (15,), standard errors.
        correlation: Shape (15, 15).
        at_limit: Shape (15,).
    """
    others = np.abs(correlation) - 2.0 * np.eye(len(NAMES))
    return tuple(
        Parameter(
            name=name,
            value=float(a[i + 1]),
            std=float(std[i]),
            verdict=_verdict(float(std[i] / a[i + 1]), bool(at_limit[i])),
            leans_on=NAMES[int(others[i].argmax())],
            correlation=float(correlation[i, others[i].argmax()]),
            at_limit=bool(at_limit[i]),
        )
        for i, name in enumerate(NAMES)
    )


def _verdict(relative_std: float, at_limit: bool) -> Verdict:
    if relative_std <= IDENTIFIED_STD and not at_limit:
        return Verdict.IDENTIFIED
    return Verdict.WEAK if relative_std <= WEAK_STD else Verdict.NOT_TOLD
