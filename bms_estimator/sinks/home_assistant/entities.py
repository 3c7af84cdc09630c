"""Numeric entities of a pack in Home Assistant.

Home Assistant's recorder stores a row for each change of each entity. The values of entities therefore have
a separate topic, on which they are rounded and published rarely (``entity_values``). Entities for research are disabled by default.
"""

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Info
from bms_estimator.model.quantity import Entity, field_entities, raw_entity

ESTIMATE = field_entities(Estimate, "all")
"""Entities of every pack."""
CHARGE_STATE = field_entities(Estimate, "batteries") | {
    "soc_std_percent": Entity("State of charge, standard deviation", "%", 1, 0.2, icon="plus-minus-variant"),
    "time_to_cutoff_h": Entity("Time to cut-off", "h", 2, 0.05, "duration", is_primary=True, icon="timer-sand"),
    "time_to_cutoff_p05_h": raw_entity("Time to cut-off, 5 % quantile", "h", 2, "duration"),
    "time_to_cutoff_p95_h": raw_entity("Time to cut-off, 95 % quantile", "h", 2, "duration"),
    "cutoff_within_15min_percent": Entity(
        "Probability of cut-off within 15 min", "%", 0, 5.0, is_primary=True, icon="power-plug-off"
    ),
    "time_to_full_h": Entity("Time to full", "h", 2, 0.05, "duration", is_primary=True, icon="battery-clock"),
    "soh_percent": Entity("State of health, capacity of new", "%", 1, 0.2, icon="battery-heart-variant"),
    "soh_std_percent": raw_entity("State of health, standard deviation", "%", 1),
}
"""Entities of a battery that a fuel cell does not have.

``field_entities`` cannot make the entities listed here, because their units differ from those of the payloads.
"""
CELL_VOLTAGES = field_entities(Estimate, "with cell voltages")
"""Entities of packs with measured cell voltages."""
CELL = "cell_v"
"""Key in ``[home_assistant.names]`` that renames the voltages of all single cells; each name ends in the number."""
ELEMENTS = {
    "r_s_mohm": Entity("Internal resistance R_s", "mΩ", decimals=1, step=0.5, icon="resistor"),
    # ``raw_entity``: internal value, disabled by default; its minimum change is one unit of the last decimal
    "r_ts_ohm": raw_entity("R_ts", "Ω", 4),
    "r_tl_ohm": raw_entity("R_tl", "Ω", 4),
    "c_ts_farad": raw_entity("C_ts", "F", 0),
    "c_tl_farad": raw_entity("C_tl", "F", 0),
}
"""Entities of a battery's learned parameters, by element of ``ParameterReport``."""
STACK = {
    "r_ohm": Entity("Resistance", "Ω", decimals=4, step=0.0005),
    "tafel_slope_v": raw_entity("Tafel slope", "V", 4),
    "exchange_current_a": raw_entity("Exchange current", "A", 9),
    "c_dl_farad": raw_entity("Double layer capacitance", "F", 4),
    "concentration_v": raw_entity("Concentration loss B", "V", 4),
    "limiting_current_a": raw_entity("Limiting current", "A", 2),
    "internal_current_a": raw_entity("Internal current", "A", 4),
}
"""Entities of a fuel cell's learned parameters, by element of ``ParameterReport``."""
BATTERY = ESTIMATE | CHARGE_STATE | ELEMENTS
FUEL_CELL = ESTIMATE | STACK


def cell_key(number: int) -> str:
    """Return the key of a single cell's voltage; numbers start from 1."""
    return f"cell_{number}_v"


def entities(info: Info, cells: int) -> dict[str, Entity]:
    """Return the numeric entities of a pack with ``cells`` measured cells, by key."""
    without_cells = FUEL_CELL if info.capacity_ah is None else BATTERY
    if not cells:
        return without_cells
    return (
        without_cells
        | CELL_VOLTAGES
        | {cell_key(n): raw_entity(f"Cell {n}", "V", 3, "voltage") for n in range(1, cells + 1)}
    )
