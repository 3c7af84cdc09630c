"""One hour of a pack in one row: measurements, and estimates at its end. The rows that fleet queries use."""

from typing import Annotated

from pydantic import ConfigDict, Field

from bms_estimator.model.payloads import Payload

HOUR_S = 3600
Correlation = Annotated[float, Field(ge=-1.001, le=1.001)]


class Hour(Payload):
    """One row. Charge and energy out are of discharge; std are of one standard deviation; unknown values are null."""

    model_config = ConfigDict(extra="ignore")  # the collector may be older than the worker

    pack: str
    hour: int = Field(description="its begin, hours since 1970 UTC")
    cell: str = Field(description="cell file or chemistry, as set; with series, parallel and capacity_ah: the type")
    series: int
    parallel: int
    capacity_ah: float | None = Field(description="declared, of the pack [Ah]; null of a fuel cell")
    samples: int = Field(description="accepted")
    dropped: int = Field(description="samples that could not be used")
    outliers: int = Field(description="samples that the filter did not believe")
    searches: int = Field(description="times the SOC became unknown, and was searched anew")
    gaps: int = Field(description="times when samples were missing")
    lost_blocks: int = Field(description="blocks that never came")
    seen_s: float = Field(description="so much of the hour was measured [s]")
    rest_s: float = Field(description="at its end next to no current had flowed for so long [s]")
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
    innovation_rms_v: float | None = Field(description="measured less predicted voltage [V]")
    stability_margin_min: float | None = Field(description="least soc - max(delta_1, delta_2) in the hour")
    soc: float | None = Field(description="state of charge at the end, 0..1, as are all that follow")
    soc_std: float | None = Field(description="as published: of the emptiest of cells in series")
    soc_mean_std: float | None = Field(description="of the mean of the cells in series alone, as the filter has it")
    capacity_ratio: float | None = Field(description="true over declared capacity")
    capacity_ratio_std: float | None
    capacity_first_std: float | None = Field(description="of capacity_ratio, before any sample")
    current_offset_a: float | None = Field(description="what the current sensor shows at no current [A]")
    current_offset_std_a: float | None
    soc_capacity_correlation: Correlation | None = Field(description="of the errors of soc and ln(capacity_ratio)")
    soc_offset_correlation: Correlation | None = Field(description="of the errors of soc and current_offset_a")
    capacity_offset_correlation: Correlation | None
    r_s_ratio: float | None = Field(description="R_s over that of the cell file at the same SOC and temperature")
    r_s_ratio_std: float | None
    r_s_unlearned_s: float | None = Field(description="since data last told of R_s [s]; null: never")
    r_s_ohm: float | None = Field(description="elements at the SOC of the end")
    r_s_std_ohm: float | None
    r_ts_ohm: float | None
    r_ts_std_ohm: float | None
    tau_ts_s: float | None
    tau_ts_std_s: float | None
    r_tl_ohm: float | None
    r_tl_std_ohm: float | None
    tau_tl_s: float | None
    tau_tl_std_s: float | None
    delta_1: float | None = Field(description="SOC below which C_ts is negative (2.11)")
    delta_2: float | None = Field(description="SOC below which C_tl is negative (2.12)")
    suspects: int = Field(description="bits of model.input_faults.InputFault")
