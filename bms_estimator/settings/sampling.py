"""Sampling of a source: period, resolution, dead band and gain errors; and limits of charger and protection."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ChargeLimits:
    """Limits of a pack; None: the default of the cell file."""

    full_voltage_v: float | None = None
    """Terminal voltage at which the charger ends a charge [V]."""
    tail_current_a: float | None = None
    """Charge current at which the charger ends a charge [A]."""
    cutoff_voltage_v: float | None = None
    """Terminal voltage at which the protection ends a discharge [V]."""


NO_LIMITS = ChargeLimits()
"""Defaults of the cell file."""


@dataclass(frozen=True)
class Sampling:
    """Period, current resolution and gain errors of a source.

    The defaults are the period of a board of the firmware, and an exact sensor.
    """

    period_s: float = 0.01
    """Time between two samples [s]."""
    current_resolution_a: float = 0.0
    """Resolution of the current [A]; 0: negligible."""
    current_dead_band_a: float = 0.0
    """Magnitude below which the device reports a current of 0 [A]."""
    voltage_gain_std: float = 0.0
    """Relative std of the voltage sensor's gain."""
    current_gain_std: float = 0.0
    """Relative std of the current sensor's gain."""


BOARD_GAIN_STD = 0.001
"""Relative std of the gains of a calibrated board, and an upper limit for laboratory instruments."""
EXACT = Sampling()
"""Sampling with the period of a board and exact gains."""
BOARD = Sampling(voltage_gain_std=BOARD_GAIN_STD, current_gain_std=BOARD_GAIN_STD)
"""Sampling of a calibrated board of the firmware."""
