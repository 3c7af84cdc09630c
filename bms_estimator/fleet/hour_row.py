"""Row of the fleet queries: measurements of one hour of a pack, and estimates at the end of the hour."""

from typing import Annotated

from pydantic import ConfigDict, Field

from bms_estimator.model.payloads.health import Payload

HOUR_S = 3600
"""Length of an hour [s]."""
Correlation = Annotated[float, Field(ge=-1.001, le=1.001)]
"""Correlation coefficient, -1 to 1 up to rounding errors."""


class Hour(Payload):
    """Row of one hour. ``out`` means discharge, ``std`` one standard deviation; unknown values are null."""

    model_config = ConfigDict(extra="ignore")  # the collector may be older than the worker

    pack: str
    hour: int = Field(description="beginning of the hour, in hours since 1970 UTC")
    cell: str = Field(
        description="configured cell file or chemistry; together with series, parallel and capacity_ah the type of the pack"
    )
    series: int
    parallel: int
    capacity_ah: float | None = Field(description="rated capacity of the pack [Ah]; null for a fuel cell")
    samples: int = Field(description="number of accepted samples")
    dropped: int = Field(description="number of rejected samples")
    outliers: int = Field(description="number of voltages that failed the filter's innovation gate")
    searches: int = Field(
        description="number of re-initializations of the filter because its SOC was inconsistent with the voltage"
    )
    gaps: int = Field(description="number of gaps between samples")
    lost_blocks: int = Field(description="number of blocks that were never received")
    seen_s: float = Field(description="measured part of the hour [s]")
    rest_s: float = Field(description="duration of the rest that lasts at the end of the hour [s]")
    charge_out_ah: float
    charge_in_ah: float
    energy_out_wh: float
    energy_in_wh: float
    voltage_v: float | None = Field(description="mean [V]")
    voltage_min_v: float | None
    voltage_max_v: float | None
    current_a: float | None = Field(description="mean, positive on discharge [A]")
    current_min_a: float | None
    current_max_a: float | None
    temperature_c: float | None = Field(description="mean [C]; null without a sensor")
    temperature_min_c: float | None
    temperature_max_c: float | None
    innovation_rms_v: float | None = Field(description="RMS of measured less predicted voltage [V]")
    stability_margin_min: float | None = Field(
        description="minimum of soc - max(delta_1, delta_2) in the hour, over samples that have a stability margin"
    )
    soc: float | None = Field(description="state of charge 0..1 at the end of the hour, as are all following values")
    soc_std: float | None = Field(description="standard deviation of the emptiest series cell's SOC, as published")
    soc_mean_std: float | None = Field(
        description="standard deviation of the mean SOC of the series cells, without the spread between cells"
    )
    capacity_ratio: float | None = Field(description="estimated divided by rated capacity")
    capacity_ratio_std: float | None
    capacity_first_std: float | None = Field(description="standard deviation of capacity_ratio before the first sample")
    current_offset_a: float | None = Field(description="estimated reading of the current sensor at zero current [A]")
    current_offset_std_a: float | None
    soc_capacity_correlation: Correlation | None = Field(
        description="correlation of the errors of soc and ln(capacity_ratio)"
    )
    soc_offset_correlation: Correlation | None = Field(
        description="correlation of the errors of soc and current_offset_a"
    )
    capacity_offset_correlation: Correlation | None
    r_s_ratio: float | None = Field(description="R_s divided by the cell file's at equal SOC and temperature")
    r_s_ratio_std: float | None
    r_s_unlearned_s: float | None = Field(description="time since R_s was last identified [s]; null: never")
    r_s_ohm: float | None = Field(description="circuit elements at the SOC at the end of the hour")
    r_s_std_ohm: float | None
    r_ts_ohm: float | None
    r_ts_std_ohm: float | None
    tau_ts_s: float | None
    tau_ts_std_s: float | None
    r_tl_ohm: float | None
    r_tl_std_ohm: float | None
    tau_tl_s: float | None
    tau_tl_std_s: float | None
    delta_1: float | None = Field(description="SOC below which C_ts is negative, (2.11) of the thesis")
    delta_2: float | None = Field(description="SOC below which C_tl is negative, (2.12) of the thesis")
    suspects: int = Field(description="bits of model.input_faults.InputFault")
    weakest_cell: int | None = Field(
        default=None,
        description="number, from 1, of the series cell with the lowest sum of SOC deviation and three std; null before an "
        "estimate of the single cells, as are the following fields up to self_discharge_std_a",
    )
    weakest_cell_soc_deviation: float | None = Field(
        default=None, description="SOC of weakest_cell less the mean SOC of the cells"
    )
    weakest_cell_soc_deviation_std: float | None = Field(default=None)
    weakest_cell_resistance_ratio: float | None = Field(
        default=None, description="resistance of weakest_cell relative to the median of the cells"
    )
    cell_soc_spread: float | None = Field(default=None, description="highest less lowest SOC of the cells")
    smallest_cell: int | None = Field(
        default=None, description="number of the series cell with the smallest capacity, from 1"
    )
    smallest_cell_capacity_ratio: float | None = Field(
        default=None, description="capacity of smallest_cell relative to the median of the cells"
    )
    resistive_cell: int | None = Field(
        default=None,
        description="number of the series cell with the highest resistance ratio less three std, from 1",
    )
    resistive_cell_ratio: float | None = Field(
        default=None, description="resistance of resistive_cell relative to the median of the cells"
    )
    resistive_cell_ratio_std: float | None = Field(default=None)
    self_discharge_cell: int | None = Field(
        default=None, description="number of the series cell with the most significant self-discharge, from 1"
    )
    self_discharge_a: float | None = Field(
        default=None, description="self-discharge current of self_discharge_cell above the median of the cells [A]"
    )
    self_discharge_std_a: float | None = Field(default=None, description="standard deviation of self_discharge_a [A]")
    alarms: str | None = Field(
        default=None, description="names of the alarms that are raised at the end of the hour, with spaces between them"
    )
    revision: int | None = Field(
        default=None,
        description="stream sequence number of the block that finished the row; of two rows of one hour the one with the "
        "larger revision is valid; null from an older worker",
    )
    received_hour: int | None = Field(
        default=None,
        description="hour on the server's clock in which the block that finished the row arrived, in hours since 1970 UTC; null "
        "from an older worker",
    )
    clock_error_s: float | None = Field(
        default=None,
        description="error of the edge's clock, positive if ahead [s]; null within the limits; a row "
        "with an error is quarantined",
    )
