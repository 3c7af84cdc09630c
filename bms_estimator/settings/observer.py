"""``[observer]`` and ``[identifier]``: adaptive observer and joint Kalman filter."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from bms_estimator.model.config_file import NotNegative, Positive, Strict


class ObserverSettings(Strict):
    """Adaptive observer, Algorithm 1 of the thesis; numbers in parentheses are equations of the thesis."""

    law: Literal["improved", "scheme-1", "scheme-2", "scheme-3", "learning"] = Field(
        default="improved",
        description="adaptation law. improved: (3.18) with output (4.1); scheme-1..3: (3.16)..(3.18) with (3.14); learning: identifies parameters, the default with identifier.enabled = false",
    )
    nussbaum: Literal["mittag-leffler", "k2-cos", "k-cos-sqrt", "ln-cos-sqrt-ln"] = "mittag-leffler"
    alpha: Annotated[float, Field(gt=2, le=3)] = Field(default=2.5, description="a of (3.10), in (2, 3]")
    lambda_: Positive = Field(default=1.0, alias="lambda", description="lambda of (3.10)")
    k0: NotNegative = Field(default=0.0, description="k(t0) of (3.13)")
    dead_zone_v: NotNegative | None = Field(
        default=None,
        description="errors below it do not raise k; default: from the sensor's resolution; 0: (3.13) as printed",
    )
    epsilon_v: Positive | None = Field(
        default=None, description="eps2 of Algorithm 1: an error below it counts as converged"
    )
    gain_limit: Positive = Field(default=1e3, description="limit of |N|")
    rearm_gain: float | None = Field(
        default=0.5,
        description='in lock, k is reset if N falls below it; "never": the printed law',
    )
    lock_error_v: Positive | None = Field(
        default=None, description="an error above it for lock_time_s is a loss of lock"
    )
    lock_time_s: Positive = 10.0
    margin_guard: Annotated[float, Field(ge=1e-6, le=1)] = Field(
        default=0.005,
        description="distance above max(delta1, delta2), where a capacitance is 0, at which adaptation stops",
    )
    scheme_2_lambda: Positive = Field(default=100.0, description="lambda_i of (3.17)")
    scheme_2_epsilon: Positive = Field(default=0.35, description="parameters up to this value are penalized, (3.17)")

    @model_validator(mode="before")
    @classmethod
    def _no_rearm(cls, table: object) -> object:
        """Convert ``rearm_gain = "never"`` to None, because TOML has no null."""
        if isinstance(table, dict) and table.get("rearm_gain") == "never":
            return table | {"rearm_gain": None}
        return table


class IdentifierSettings(Strict):
    """Identifier: joint Kalman filter for SOC, its error, and the cell's parameters."""

    enabled: bool = Field(default=True, description="false: SOC by coulomb counting, parameters by the observer's law")
    map_memory_h: Annotated[float, Field(ge=1)] = Field(
        default=336.0, description="time constant of forgetting learned elements"
    )
    current_offset_std_a: NotNegative | None = Field(
        default=None,
        description="standard deviation of the current sensor's offset; default: from the capacity; 0: no offset",
    )
    capacity_std: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        default=None,
        description="relative standard deviation of the capacity; default: that of the cell file; 0: capacity is exact",
    )
    soc_std: Annotated[float, Field(ge=0.005, le=0.5)] | None = Field(
        default=None, description="standard deviation of the initial SOC; default: 0.2"
    )
    hysteresis_v: NotNegative | None = Field(
        default=None,
        description="OCV of one cell after charge minus that after discharge; default: that of the cell file",
    )
