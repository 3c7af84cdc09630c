"""Sampling of a source: period, current resolution and dead band."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Sampling:
    """Period and current resolution of a source; the defaults are those of a board of the firmware."""

    period_s: float = 0.01
    """Time between two samples [s]."""
    current_resolution_a: float = 0.0
    """Resolution of the current [A]; 0: negligible."""
    current_dead_band_a: float = 0.0
    """Magnitude below which the device reports a current of 0 [A]."""


BOARD = Sampling()
"""Sampling of a board of the firmware."""
