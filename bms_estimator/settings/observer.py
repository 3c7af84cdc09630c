"""``[observer]`` and ``[identifier]``: adaptive observer and joint Kalman filter; and the sampling and the limits of their input."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from bms_estimator.model.config_file import NotNegative, Positive, Strict


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


SCHEME_2_LAMBDA = 100.0
"""Rate lambda_i in (3.17), as in the simulations of the thesis [1/s]."""
SCHEME_2_EPSILON = 0.35
"""Largest parameter that (3.17) returns to its initial value."""


class ObserverSettings(Strict):
    """Adaptive observer: Algorithm 1 of the thesis. Numbers in parentheses are equations of the thesis (docs/theory/thesis.md)."""

    law: Literal["improved", "scheme-1", "scheme-2", "scheme-3", "learning"] = Field(
        default="improved",
        description="adaptation law of the parameters. improved: (3.18) with output (4.1); scheme-1 to scheme-3: (3.16) to (3.18) with output (3.14); learning: identifies the parameters, and is the default if identifier.enabled = false",
    )
    nussbaum: Literal["mittag-leffler", "k2-cos", "k-cos-sqrt", "ln-cos-sqrt-ln"] = Field(
        default="mittag-leffler", description="Nussbaum function N(k), which multiplies the voltage error"
    )
    alpha: Annotated[float, Field(gt=2, le=3)] = Field(
        default=2.5, description="exponent a of the Mittag-Leffler function (3.10), in (2, 3]"
    )
    lambda_: Positive = Field(
        default=1.0, alias="lambda", description="factor lambda in the Mittag-Leffler function (3.10)"
    )
    k0: NotNegative = Field(default=0.0, description="initial value of the adaptive gain k, k(t0) in (3.13)")
    dead_zone_v: NotNegative | None = Field(
        default=None,
        description="voltage errors below this value do not increase k; default: two steps of sensor.voltage_resolution_v; 0: (3.13) as printed in the thesis",
    )
    epsilon_v: Positive | None = Field(
        default=None,
        description="voltage error below which Algorithm 1 counts as converged (eps2); default: twice the larger of dead_zone_v and sensor.voltage_resolution_v",
    )
    gain_limit: Positive = Field(default=1e3, description="limit of the magnitude of N(k)")
    rearm_gain: float | None = Field(
        default=0.5,
        description='while the observer is in lock (see lock_error_v), k is reset to k0 when N(k) falls below this value; "never": k only grows, as printed in the thesis',
    )
    lock_error_v: Positive | None = Field(
        default=None,
        description="the observer is in lock while its voltage error is at most this value; default: 2 % of the nominal voltage, or ten steps of sensor.voltage_resolution_v if these are larger",
    )
    lock_time_s: Positive = Field(
        default=10.0, description="a voltage error above lock_error_v for this time is a loss of lock"
    )
    margin_guard: Annotated[float, Field(ge=1e-6, le=1)] = Field(
        default=0.005,
        description="adaptation stops if the SOC is less than this above max(delta1, delta2), at which a capacitance of the model is 0",
    )

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Return names and values for ``repr``, whose hash identifies the settings of a stored state.

        Constants that earlier versions had as settings are included, so that the hashes of stored states stay valid.
        """
        yield from super().__repr_args__()
        yield "scheme_2_lambda", SCHEME_2_LAMBDA
        yield "scheme_2_epsilon", SCHEME_2_EPSILON

    @model_validator(mode="before")
    @classmethod
    def _convert_never_to_none(cls, table: object) -> object:
        """Convert ``rearm_gain = "never"`` to None, because TOML has no null."""
        if isinstance(table, dict) and table.get("rearm_gain") == "never":
            return table | {"rearm_gain": None}
        return table


class _IdentifierSwitches(Strict):
    """Switches of ``[identifier]``. The packs of a fleet always have both."""

    enabled: bool = Field(
        default=True,
        description="false: the SOC is counted from the current, and the observer's law estimates the parameters",
    )
    pack_model: bool = Field(
        default=True,
        repr=False,  # not part of the digest of a fleet's settings
        description="true: OCV curve, capacity and resistances are fitted to weeks of the pack's history; false: they are those of the cell file, with the corrections that the filter learns",
    )


class IdentifierValues(Strict):
    """Settings of ``[identifier]`` that are also columns of a fleet's table of packs."""

    map_memory_h: Annotated[float, Field(ge=1)] = Field(
        default=336.0, description="time constant with which old values of learned parameters lose weight"
    )
    current_offset_std_a: NotNegative | None = Field(
        default=None,
        description="standard deviation of the current sensor's offset; default: 0.7 % of the 1C current; 0: no offset",
    )
    capacity_std: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        default=None,
        description="relative standard deviation of the capacity; default: that of the cell file; 0: the capacity is exact",
    )
    soc_std: Annotated[float, Field(ge=0.005, le=0.5)] | None = Field(
        default=None, description="standard deviation of the initial SOC; default: 0.2"
    )
    hysteresis_v: NotNegative | None = Field(
        default=None,
        description="OCV of one cell after charge minus its OCV after discharge; default: hysteresis in the cell file",
    )
    fit_interval_s: Annotated[float, Field(ge=600)] | None = Field(
        default=None,
        repr=False,  # not part of the digest of a fleet's settings, because a state does not depend on it
        description="maximum interval between two fits of the pack's model; default: 3600, in a fleet 86400",
    )


class IdentifierSettings(IdentifierValues, _IdentifierSwitches):
    """Identifier: joint Kalman filter for the SOC, its standard deviation, and the cell's parameters."""
