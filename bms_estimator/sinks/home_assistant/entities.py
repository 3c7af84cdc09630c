"""Numeric entities of a pack in Home Assistant.

Home Assistant's recorder stores a row for each change of each entity. Its values therefore have a separate topic, on
which they are rounded and published rarely (``entity_values``). Entities for research are disabled by default.
"""

import math
from typing import NamedTuple

from bms_estimator.model.payloads import Info

FAST_INTERVAL_S = 15.0
"""Minimum interval between two rows of a value that follows the load [s]."""
SLOW_INTERVAL_S = 60.0
"""Minimum interval between two rows of any other value [s]."""


class Entity(NamedTuple):
    """Numeric entity of Home Assistant."""

    name: str | None
    """Name; None: Home Assistant's name of the device class, in the user's language."""
    unit: str | None
    decimals: int
    """Number of decimals of a published value."""
    step: float
    """Minimum change that is published, in the entity's unit; it exceeds the noise."""
    device_class: str | None = None
    min_interval_s: float = SLOW_INTERVAL_S
    """Minimum interval between two published changes [s]."""
    is_primary: bool = False
    """True for a primary entity; others are listed as diagnostics."""
    enabled: bool = True
    """True if enabled by default."""
    state_class: str | None = "measurement"
    signed: bool = False
    """True if the sign depends on the configured direction of positive current."""
    immediate_step: float = math.inf
    """Minimum change that is published at once, as after a user has set the SOC."""


def _raw(name: str, unit: str | None, decimals: int, device_class: str | None = None) -> Entity:
    """Return the entity of an internal value of the observer."""
    return Entity(name, unit, decimals, 10.0**-decimals, device_class, enabled=False)


def _total(name: str, unit: str | None, decimals: int, device_class: str | None = None) -> Entity:
    """Return the entity of a total over all runs."""
    step = 10.0**-decimals
    return Entity(name, unit, decimals, step, device_class, is_primary=True, state_class="total_increasing")


def _count(name: str) -> Entity:
    """Return the entity of a counter since start."""
    return Entity(name, None, 0, 1.0, enabled=False, state_class="total_increasing")


ESTIMATE = {
    "voltage_v": Entity(None, "V", 2, 0.02, "voltage", FAST_INTERVAL_S, is_primary=True),
    "current_a": Entity(None, "A", 2, 0.05, "current", FAST_INTERVAL_S, is_primary=True, signed=True),
    "power_w": Entity(None, "W", 1, 0.5, "power", FAST_INTERVAL_S, is_primary=True, signed=True),
    "temperature_c": Entity(None, "°C", 1, 0.3, "temperature", is_primary=True),
    "energy_out_kwh": _total("Energy out", "kWh", 3, "energy"),
    "energy_in_kwh": _total("Energy in", "kWh", 3, "energy"),
    "charge_out_ah": _total("Charge out", "Ah", 2)._replace(enabled=False),
    "charge_in_ah": _total("Charge in", "Ah", 2)._replace(enabled=False),
    "frames_lost": _count("Frames lost"),
    "crc_errors": _count("CRC errors"),
    "voltage_estimate_v": _raw("Estimated voltage", "V", 2, "voltage"),
    "innovation_v": _raw("Innovation", "V", 3, "voltage"),
    "adaptive_gain_k": _raw("Adaptive gain k", "V²s", 6),
    "adaptation_gain_hz": _raw("Adaptation gain", "1/s", 4),
    "sample_rate_hz": _raw("Sample rate", "Hz", 1, "frequency"),
}
CHARGE_STATE = {
    "soc_percent": Entity(None, "%", 1, 0.2, "battery", is_primary=True, immediate_step=2.0),
    "soc_std_percent": Entity("State of charge, standard deviation", "%", 1, 0.2, is_primary=True),
    "remaining_capacity_ah": Entity("Remaining capacity", "Ah", 2, 0.02, is_primary=True),
    "remaining_energy_wh": Entity("Remaining energy", "Wh", 1, 0.2, "energy_storage", is_primary=True),
    "time_to_empty_h": Entity("Time to empty", "h", 2, 0.05, "duration", is_primary=True),
    "time_to_full_h": Entity("Time to full", "h", 2, 0.05, "duration", is_primary=True),
    "equivalent_cycles": _total("Equivalent cycles", None, 2),
    "soh_percent": Entity("State of health", "%", 1, 0.2),
    "soh_std_percent": Entity("State of health, standard deviation", "%", 1, 0.2),
    "usable_capacity_ah": _raw("Usable capacity", "Ah", 2),
    "stability_margin": _raw("Stability margin", None, 3),
    "delta_1": _raw("delta 1", None, 4),
    "delta_2": _raw("delta 2", None, 4),
    "nussbaum_gain": _raw("Nussbaum gain", None, 3),
}
"""Entities of a battery that a fuel cell does not have."""
CELL_VOLTAGES = {
    "cell_lowest": Entity("Weakest cell", None, 0, 1.0, state_class=None),
    "cell_lowest_v": Entity("Weakest cell, voltage", "V", 3, 0.005, "voltage"),
    "cell_highest": Entity("Highest cell", None, 0, 1.0, enabled=False, state_class=None),
    "cell_highest_v": _raw("Highest cell, voltage", "V", 3, "voltage"),
}
"""Entities of packs with measured cell voltages."""
CELL = "cell_v"
"""Key in ``[home_assistant.names]`` that renames the voltages of all single cells; each name ends in the number."""
ELEMENTS = {
    "r_s_ohm": Entity("R_s", "Ω", 4, 0.0005),
    "r_ts_ohm": _raw("R_ts", "Ω", 4),
    "r_tl_ohm": _raw("R_tl", "Ω", 4),
    "c_ts_farad": _raw("C_ts", "F", 0),
    "c_tl_farad": _raw("C_tl", "F", 0),
}
"""Entities of a battery's learned parameters, by element of ``ParameterReport``."""
STACK = {
    "r_ohm": Entity("Resistance", "Ω", 4, 0.0005),
    "tafel_slope_v": _raw("Tafel slope", "V", 4),
    "exchange_current_a": _raw("Exchange current", "A", 9),
    "c_dl_farad": _raw("Double layer capacitance", "F", 4),
    "concentration_v": _raw("Concentration loss B", "V", 4),
    "limiting_current_a": _raw("Limiting current", "A", 2),
    "internal_current_a": _raw("Internal current", "A", 4),
}
"""Entities of a fuel cell's learned parameters, by element of ``ParameterReport``."""
BATTERY = ESTIMATE | CHARGE_STATE | ELEMENTS
FUEL_CELL = ESTIMATE | STACK


def cell_key(number: int) -> str:
    """Return the key of a single cell's voltage; numbers start from 1."""
    return f"cell_{number}_v"


def entities(info: Info, cells: int) -> dict[str, Entity]:
    """Return the numeric entities of a pack with ``cells`` measured cells, by key."""
    common = FUEL_CELL if info.capacity_ah is None else BATTERY
    if not cells:
        return common
    return common | CELL_VOLTAGES | {cell_key(n): _raw(f"Cell {n}", "V", 3, "voltage") for n in range(1, cells + 1)}
