"""``[observer]`` and ``[identifier]``: adaptive observer and filter."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from bms_estimator.model.config_file import NotNegative, Positive, Strict


class ObserverSettings(Strict):
    """The adaptive observer, Algorithm 1."""

    law: Literal["improved", "scheme-1", "scheme-2", "scheme-3", "learning"] = Field(
        default="improved",
        description="improved: (3.18) with output (4.1); scheme-1..3: (3.16)..(3.18) with (3.14); "
        "learning: sensitivity times e, docs/theory/observer.md, the default where identifier.enabled = false",
    )
    nussbaum: Literal["mittag-leffler", "k2-cos", "k-cos-sqrt", "ln-cos-sqrt-ln"] = "mittag-leffler"
    alpha: Annotated[float, Field(gt=2, le=3)] = Field(default=2.5, description="a of (3.10), in (2, 3]")
    lambda_: Positive = Field(default=1.0, alias="lambda", description="lambda of (3.10)")
    k0: NotNegative = Field(default=0.0, description="k(t0) of (3.13)")
    dead_zone_v: NotNegative | None = Field(
        default=None,
        description="errors below do not raise k; from the sensor's resolution when left out; 0: (3.13) as printed",
    )
    epsilon_v: Positive | None = Field(
        default=None, description="eps2 of Algorithm 1: below it the error has converged"
    )
    gain_limit: Positive = Field(default=1e3, description="clamp of |N|")
    rearm_gain: float | None = Field(
        default=0.5,
        description='below this N, in lock, k starts again; "never": the printed law',
    )
    lock_error_v: Positive | None = Field(
        default=None, description="an error beyond it for lock_time_s is a loss of lock"
    )
    lock_time_s: Positive = 10.0
    margin_guard: Annotated[float, Field(ge=1e-6, le=1)] = Field(
        default=0.005,
        description="adaptation stops this far above max(delta1, delta2); at these a capacitance is 0",
    )
    scheme_2_lambda: Positive = Field(default=100.0, description="lambda_i of (3.17)")
    scheme_2_epsilon: Positive = Field(default=0.35, description="parameters up to this value are penalised, (3.17)")

    @model_validator(mode="before")
    @classmethod
    def _no_rearm(cls, table: object) -> object:
        """``rearm_gain = "never"`` in a file, since TOML has no null."""
        if isinstance(table, dict) and table.get("rearm_gain") == "never":
            return table | {"rearm_gain": None}
        return table


class IdentifierSettings(Strict):
    """The identifier: SOC with its error, the cell's own parameters."""

    enabled: bool = Field(
        default=True, description="false: SOC by coulomb counting, parameters as the observer's law has them"
    )
    map_memory_h: Annotated[float, Field(ge=1)] = Field(
        default=336.0, description="time constant with which learned elements are forgotten"
    )
    current_offset_std_a: NotNegative | None = Field(
        default=None,
        description="how wrong the current sensor's zero may be; from the capacity when left out; 0: it is taken as right",
    )
    capacity_std: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        default=None,
        description="how wrong the declared capacity may be, relative; the cell file's when left out; "
        "0: it is taken as right",
    )
    soc_std: Annotated[float, Field(ge=0.005, le=0.5)] | None = Field(
        default=None, description="how wrong the SOC at start may be; a fifth when left out"
    )
    hysteresis_v: NotNegative | None = Field(
        default=None,
        description="OCV after charge less that after discharge, of one cell; that of the cell file when left out",
    )
