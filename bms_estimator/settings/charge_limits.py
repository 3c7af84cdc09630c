"""Voltages and current at which the owner's charger and protection end a charge and a discharge."""

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
