"""Payload of the topic ``state``."""

from typing import Annotated

from pydantic import Field

from bms_estimator.model.payloads.health import Payload
from bms_estimator.model.quantity import FAST_INTERVAL_S, Entity, Quantity, counter_entity, raw_entity, total_entity

_COUNTED = "at the terminals over all runs; with checkpoints the last saved value, so that it never decreases"


class Estimate(Payload):
    """Topic ``state``: one publish window. Voltage, current, power and temperature are means, other values the last ones."""

    time: str = Field(description="arrival time of the window's last sample, ISO 8601, UTC")
    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    board_time_s: Annotated[float, Quantity(prometheus="none")] = Field(
        description="source's clock at the last sample [s]"
    )
    voltage_v: Annotated[float, Quantity(Entity(None, "V", 2, 0.02, "voltage", FAST_INTERVAL_S, is_primary=True))] = (
        Field(description="mean pack terminal voltage [V]")
    )
    current_a: Annotated[
        float, Quantity(Entity(None, "A", 2, 0.05, "current", FAST_INTERVAL_S, is_primary=True, signed=True))
    ] = Field(description="mean current [A], positive on discharge")
    power_w: Annotated[
        float, Quantity(Entity(None, "W", 1, 0.5, "power", FAST_INTERVAL_S, is_primary=True, signed=True))
    ] = Field(description="mean of voltage times current [W], positive on discharge")
    temperature_c: Annotated[float | None, Quantity(Entity(None, "°C", 1, 0.3, "temperature", is_primary=True))] = (
        Field(description="mean temperature [C]; null without a sensor")
    )
    temperatures_c: list[float | None] | None = Field(
        description="readings of all temperature probes at the last sample [C], null for an absent probe; null with one probe"
    )
    faulty_probes: list[int] | None = Field(
        description="numbers of the faulty temperature probes at the last sample, starting at 1; null with a single probe"
    )
    cell_lowest_v: Annotated[
        float | None, Quantity(Entity("Lowest cell, voltage", "V", 3, 0.005, "voltage"), packs="with cell voltages")
    ] = Field(description="lowest cell voltage at the last sample [V]; null without cell voltages")
    cell_highest_v: Annotated[
        float | None, Quantity(raw_entity("Highest cell, voltage", "V", 3, "voltage"), packs="with cell voltages")
    ] = Field(description="highest cell voltage at the last sample [V]; null without cell voltages")
    cell_lowest: Annotated[
        int | None,
        Quantity(Entity("Lowest cell", None, 0, 1.0, state_class=None, icon="numeric"), packs="with cell voltages"),
    ] = Field(description="number of the lowest cell, from 1")
    cell_highest: Annotated[
        int | None,
        Quantity(Entity("Highest cell", None, 0, 1.0, enabled=False, state_class=None), packs="with cell voltages"),
    ] = Field(description="number of the highest cell, from 1")
    cells_v: list[float | None] | None = Field(
        description="cell voltages at the last sample [V]; null for an unknown cell, or without cell voltages"
    )
    soc: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="state of charge, 0..1; null for a fuel cell, like all values derived from it"
    )
    soc_percent: Annotated[
        float | None,
        Quantity(
            Entity(None, "%", 1, 0.2, "battery", is_primary=True, immediate_step=2.0),
            packs="batteries",
            prometheus="none",
        ),
    ] = Field(description="state of charge [%]")
    soc_std: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="standard deviation of soc; for cells in series it includes the weakest cell's, "
        "0.1 (1 - soc); null without the identifier"
    )
    soc_known: bool = Field(
        description="true: soc_std was below 0.12 and has not risen above 0.15 since, or there is no identifier; false: soc is "
        "not shown, and no alarm uses it"
    )
    device_soc: Annotated[
        float | None,
        Quantity(
            Entity("State of charge by the BMS", "%", 1, 1.0, icon="battery-outline", factor=100.0),
            packs="batteries",
            prometheus="ratio",
        ),
    ] = Field(
        description="state of charge that the device (BMS, battery monitor) reports, 0..1; null if it reports none"
    )
    device_soc_difference: Annotated[
        float | None,
        Quantity(
            raw_entity("State of charge, difference to the BMS", "%", 1)._replace(factor=100.0),
            packs="batteries",
            prometheus="ratio",
        ),
    ] = Field(description="soc minus device_soc; null if one of them is not known")
    soc_coulomb: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="state of charge by coulomb counting alone, 0..1"
    )
    soc_ocv: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="state of charge by the inverted OCV (7.1), 0..1; null if the last sample had no new voltage"
    )
    remaining_capacity_ah: Annotated[
        float | None,
        Quantity(
            Entity("Charge left to 0 %", "Ah", 2, 0.02, is_primary=True, icon="battery-medium"), packs="batteries"
        ),
    ] = Field(description="remaining charge to SOC 0 [Ah]")
    remaining_energy_wh: Annotated[
        float | None,
        Quantity(Entity("Energy left to cut-off", "Wh", 1, 0.2, "energy_storage", is_primary=True), packs="batteries"),
    ] = Field(
        description="remaining energy at the terminals to the cut-off voltage at the present load and temperature [Wh]; null "
        "without the identifier and for a fuel cell, with a forecast_reason"
    )
    time_to_cutoff_s: float | None = Field(
        description="median time until the load is switched off at the cut-off voltage [s], under a load like the observed one; "
        "below 600 s use the quantiles and probabilities; null with a forecast_reason"
    )
    time_to_cutoff_p05_s: float | None = Field(description="5 % quantile of the time until the cut-off [s]")
    time_to_cutoff_p95_s: float | None = Field(description="95 % quantile of the time until the cut-off [s]")
    cutoff_within_2min: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="probability that the load is switched off within 2 min of the forecast, 0..1"
    )
    cutoff_within_5min: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="probability that the load is switched off within 5 min of the forecast, 0..1"
    )
    cutoff_within_15min: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="probability that the load is switched off within 15 min of the forecast, 0..1"
    )
    time_to_full_s: float | None = Field(description="time until the charger ends the charge [s]; null unless charging")
    usable_capacity_ah: Annotated[
        float | None, Quantity(raw_entity("Charge left to cut-off", "Ah", 2), packs="batteries")
    ] = Field(description="remaining charge to the cut-off voltage at the present load and temperature [Ah]")
    available_discharge_power_10s_w: Annotated[
        float | None,
        Quantity(Entity("Available discharge power, 10 s", "W", 0, 5.0, "power", is_primary=True), packs="batteries"),
    ] = Field(description="constant power that the pack supplies for 10 s [W]; null while the SOC is too uncertain")
    available_discharge_power_60s_w: Annotated[
        float | None, Quantity(raw_entity("Available discharge power, 60 s", "W", 0, "power"), packs="batteries")
    ] = Field(description="constant power that the pack supplies for 60 s [W]")
    available_charge_power_10s_w: Annotated[
        float | None,
        Quantity(Entity("Available charge power, 10 s", "W", 0, 5.0, "power", is_primary=True), packs="batteries"),
    ] = Field(description="constant power that the pack accepts for 10 s [W]; null while the SOC is too uncertain")
    available_charge_power_60s_w: Annotated[
        float | None, Quantity(raw_entity("Available charge power, 60 s", "W", 0, "power"), packs="batteries")
    ] = Field(description="constant power that the pack accepts for 60 s [W]")
    forecast_reason: str | None = Field(
        description="reason why time_to_cutoff_s and its quantiles are null; null if they have values"
    )
    weakest_cell_soc: Annotated[
        float | None,
        Quantity(
            Entity("Weakest cell, state of charge", "%", 1, 1.0, icon="battery-low", factor=100.0),
            packs="batteries",
            prometheus="ratio",
        ),
    ] = Field(
        description="SOC of the weakest cell, 0..1, from the cell voltages, or without them from the voltage of the bank; null "
        "for a single cell, and before the first comparison",
    )
    weakest_cell_soc_std: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="standard deviation of weakest_cell_soc"
    )
    weakest_cell_capacity: Annotated[
        float | None,
        Quantity(
            raw_entity("Weakest cell, relative capacity", "%", 0)._replace(factor=100.0),
            packs="batteries",
            prometheus="ratio",
        ),
    ] = Field(description="capacity of the weakest cell relative to the other cells")
    usable_capacity_to_weakest_ah: Annotated[
        float | None, Quantity(raw_entity("Usable capacity to the weakest cell", "Ah", 2), packs="batteries")
    ] = Field(description="remaining charge until the weakest cell is empty [Ah]")
    weakest_cell: Annotated[
        int | None,
        Quantity(Entity("Weakest cell", None, 0, 1.0, state_class=None, icon="numeric"), packs="with cell voltages"),
    ] = Field(
        description="number of the cell with the lowest SOC, from 1; null before the first estimate of the cells, and "
        "without cell voltages",
    )
    cell_soc_spread: Annotated[
        float | None,
        Quantity(
            Entity("Cell spread, state of charge", "%", 1, 0.5, icon="arrow-expand-vertical", factor=100.0),
            packs="with cell voltages",
        ),
    ] = Field(description="highest less lowest SOC of the cells; null if weakest_cell is null")
    cell_r_spread: Annotated[
        float | None,
        Quantity(raw_entity("Cell spread, resistance", "%", 0)._replace(factor=100.0), packs="with cell voltages"),
    ] = Field(
        description="highest less lowest resistance of the cells, relative to their median; null if weakest_cell is null",
    )
    charge_out_ah: Annotated[
        float, Quantity(total_entity("Charge out", "Ah", 2)._replace(enabled=False), prometheus="counter")
    ] = Field(description=f"charge out of the pack [Ah], {_COUNTED}")
    charge_in_ah: Annotated[
        float, Quantity(total_entity("Charge in", "Ah", 2)._replace(enabled=False), prometheus="counter")
    ] = Field(description=f"charge into the pack [Ah], {_COUNTED}")
    energy_out_kwh: Annotated[float, Quantity(total_entity("Energy out", "kWh", 3, "energy"), prometheus="counter")] = (
        Field(description=f"energy out of the pack [kWh], {_COUNTED}")
    )
    energy_in_kwh: Annotated[float, Quantity(total_entity("Energy in", "kWh", 3, "energy"), prometheus="counter")] = (
        Field(description=f"energy into the pack [kWh], {_COUNTED}")
    )
    equivalent_cycles: Annotated[
        float | None, Quantity(total_entity("Full cycles", None, 2)._replace(icon="sync"), packs="batteries")
    ] = Field(description="charge_out_ah divided by the rated capacity; null for a fuel cell")
    voltage_estimate_v: Annotated[float | None, Quantity(raw_entity("Estimated voltage", "V", 2, "voltage"))] = Field(
        description="terminal voltage that the model predicts: voltage_v less innovation_v [V]"
    )
    innovation_v: Annotated[float | None, Quantity(raw_entity("Innovation", "V", 3, "voltage"))] = Field(
        description="measured minus predicted voltage at the filter's last update [V]: the error of the model; without the "
        "identifier and for a fuel cell equal to tracking_error_v"
    )
    tracking_error_v: float | None = Field(
        description="the observer's tracking error e, (3.15) [V]; it is small even with a wrong model"
    )
    delta_1: Annotated[
        float | None, Quantity(raw_entity("delta 1", None, 4), packs="batteries", prometheus="ratio")
    ] = Field(description="SOC below which C_ts is negative, (2.11)")
    delta_2: Annotated[
        float | None, Quantity(raw_entity("delta 2", None, 4), packs="batteries", prometheus="ratio")
    ] = Field(description="SOC below which C_tl is negative, (2.12)")
    delta_configured: bool = Field(
        description="true: delta_1 and delta_2 follow from the cell file and its bounds alone; false: data have changed them, or "
        "the pack is a fuel cell, which has neither"
    )
    stability_margin: Annotated[
        float | None, Quantity(raw_entity("Stability margin", None, 3), packs="batteries", prometheus="ratio")
    ] = Field(
        description="soc - max(delta_1, delta_2), the distance to the SOC below which the thesis's model is not valid; null with "
        "a stability_margin_reason, and for a fuel cell"
    )
    stability_margin_std: Annotated[float | None, Quantity(prometheus="ratio")] = Field(
        description="standard deviation of stability_margin"
    )
    stability_margin_reason: str | None = Field(
        description="reason why stability_margin is null: the SOC is not known, neither delta_1 nor delta_2 is above 0, or "
        "a7..a12 are not valid"
    )
    adaptive_gain_k: Annotated[float | None, Quantity(raw_entity("Adaptive gain k", "V²s", 6))] = Field(
        description="adaptive gain state k, (3.13) [V^2 s]"
    )
    nussbaum_gain: Annotated[float | None, Quantity(raw_entity("Nussbaum gain", None, 3), packs="batteries")] = Field(
        description="N(k), (3.12); null with the learning law"
    )
    adaptation_gain_hz: Annotated[float | None, Quantity(raw_entity("Adaptation gain", "1/s", 4))] = Field(
        description="gamma k of the learning law [1/s]; null with a law of the thesis"
    )
    converged: bool = Field(description="the observer's |tracking_error_v| is below eps2 of Algorithm 1")
    lock: bool = Field(
        description="the observer tracks the measured voltage; this does not show that the model is right"
    )
    frames_received: Annotated[int, Quantity(prometheus="counter")] = Field(description="valid frames since start")
    frames_lost: Annotated[int, Quantity(counter_entity("Frames lost"), prometheus="counter")] = Field(
        description="frames missing in the sequence numbers since start"
    )
    crc_errors: Annotated[int, Quantity(counter_entity("CRC errors"), prometheus="counter")] = Field(
        description="frames with a wrong checksum since start"
    )
    sample_rate_hz: Annotated[float | None, Quantity(raw_entity("Sample rate", "Hz", 1, "frequency"))] = Field(
        description="sample rate on the source's clock in the window [Hz]"
    )
