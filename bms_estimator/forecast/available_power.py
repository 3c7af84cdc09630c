"""Forecast of a pack: its curves, the available power, and the limits that bound it."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from bms_estimator.kernels.forecast.power import available_power, new_scratch
from bms_estimator.kernels.kalman_filter.records import SOC
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.model.cell import CellModel
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings

FORECAST = np.dtype(
    [
        ("time_to_cutoff_s", "f8"),  # median time until the terminal voltage reaches the cut-off voltage [s]
        ("time_to_cutoff_p05_s", "f8"),  # 5 % quantile of that time [s]
        ("time_to_cutoff_p95_s", "f8"),  # 95 % quantile of that time [s]
        ("cutoff_within_2min", "f8"),  # probability of the cut-off within 120 s, 0..1
        ("cutoff_within_5min", "f8"),  # probability of the cut-off within 300 s, 0..1
        ("cutoff_within_15min", "f8"),  # probability of the cut-off within 900 s, 0..1
        ("time_to_full_s", "f8"),  # time until the charger ends the present charge [s]
        ("usable_capacity_ah", "f8"),  # charge to the cut-off at the present load and temperature [Ah]
        ("remaining_energy_wh", "f8"),  # energy at the terminals to the cut-off at the present load [Wh]
        ("available_discharge_power_10s_w", "f8"),  # constant power that the pack supplies for 10 s [W]
        ("available_discharge_power_60s_w", "f8"),  # constant power that the pack supplies for 60 s [W]
        ("available_charge_power_10s_w", "f8"),  # constant power that the pack accepts for 10 s [W]
        ("available_charge_power_60s_w", "f8"),  # constant power that the pack accepts for 60 s [W]
    ],
    align=True,
)
"""Values of a forecast; NaN if unknown. The published fields have the same names."""

ForecastRows = Records
"""Shape (n,), dtype ``FORECAST``."""


@dataclass(frozen=True)
class ForecastCurve:
    """Quantiles as functions of the time after the forecast, each of shape (n,).

    Attributes:
        elapsed_s: Time from the forecast [s], increasing.
        soc_p05, soc_p50, soc_p95: Quantiles of the SOC, 0..1.
        voltage_p05_v, voltage_p50_v, voltage_p95_v: Quantiles of the terminal voltage [V].
        survival: Probability that the cut-off is later than ``elapsed_s``, 0..1.
    """

    elapsed_s: Floats
    soc_p05: Floats
    soc_p50: Floats
    soc_p95: Floats
    voltage_p05_v: Floats
    voltage_p50_v: Floats
    voltage_p95_v: Floats
    survival: Floats


@dataclass(frozen=True)
class Forecast:
    """Forecast at one sample.

    Attributes:
        time_s: Time stamp of the sample [s].
        values: Shape (1,), dtype ``FORECAST``.
        reason: Reason why the time to the cut-off is unknown; None if it is known.
        curve: Curves; None without a time to the cut-off.
    """

    time_s: float
    values: ForecastRows
    reason: str | None
    curve: ForecastCurve | None


def unknown_values() -> ForecastRows:
    """Return values that are all unknown, shape (1,), dtype ``FORECAST``."""
    return np.array([(np.nan,) * len(FORECAST.names or ())], FORECAST)


NO_FORECAST = unknown_values()
"""Forecast at all samples of a pack without forecasts."""


QUANTILE_STDS = 1.645
"""Distance of the 5 % quantile of a normal distribution from its mean, in standard deviations."""
DURATIONS_S = 10.0, 60.0
"""Durations of the available power [s]."""


UNSEEN_DISCHARGE_C = 1.0
"""Discharge current that a pack without a configured limit is assumed to supply, even if none was observed yet, as a C-rate
[1/h]. Nearly all cells are rated for it."""
UNSEEN_CHARGE_C = 0.5
"""Charge current that a pack without a configured limit is assumed to accept, even if none was observed yet, as a C-rate [1/h].
Nearly all cells are rated for it."""
MIN_QUANTILE_RATIO = 0.5
"""Minimum ratio of the 5 % quantile of the power to its median. Below it the power is unknown if the SOC is the cause."""


@dataclass(frozen=True)
class PowerLimits:
    """Limits of current and temperature that bound the available power.

    Attributes:
        discharge_a: Largest discharge current [A], above 0.
        charge_a: Largest charge current [A], above 0.
        charge_min_c: Temperature below which the pack must not be charged [C].
        unseen_discharge_a: Limit of the discharge current until a larger one is observed [A].
        unseen_charge_a: Limit of the charge current until a larger one is observed [A].
    """

    discharge_a: float
    charge_a: float
    charge_min_c: float = 0.0
    unseen_discharge_a: float = np.inf
    unseen_charge_a: float = np.inf

    def with_seen(self, discharge_a: float, charge_a: float) -> Self:
        """Return the limits after these currents were observed.

        Args:
            discharge_a: Largest discharge current so far [A], at least 0.
            charge_a: Largest charge current so far [A], at least 0.
        """
        return replace(
            self,
            discharge_a=min(self.discharge_a, max(self.unseen_discharge_a, discharge_a)),
            charge_a=min(self.charge_a, max(self.unseen_charge_a, charge_a)),
        )

    def charge_limit_a(self, temperature_c: float) -> float:
        """Return the largest charge current at a temperature [A]; 0 if the pack must not be charged."""
        return self.charge_a if temperature_c >= self.charge_min_c else 0.0


def cell_power_limits(pack: PackModel) -> PowerLimits:
    """Return the limits of a pack without settings: ``current_max_a`` of the cell file in both directions.

    Args:
        pack: Model of the whole pack.
    """
    max_a, one_c_a = pack.cell.current_max_a, pack.one_c_a
    return PowerLimits(
        max_a,
        max_a,
        unseen_discharge_a=UNSEEN_DISCHARGE_C * one_c_a,
        unseen_charge_a=UNSEEN_CHARGE_C * one_c_a,
    )


def power_limits(settings: Settings, cell: CellModel) -> PowerLimits:
    """Return the limits that the settings of the pack and its alarms set.

    A current limit is the smallest of ``pack.max_discharge_a`` or ``pack.max_charge_a``, the limit of the alarm on the current
    if it is monitored, and ``current_max_a`` of the cell file. If the alarm on charging below freezing is switched off, no
    temperature limits the charge.

    Args:
        settings: Settings of the pack.
        cell: Model of the whole pack.
    """
    alarms = {alarm.name: alarm.limit for alarm in monitored_alarms(settings, cell)}
    pack, limits = settings.pack, cell_power_limits(cell)
    return PowerLimits(
        min(pack.max_discharge_a or np.inf, alarms.get("discharge_over_current", np.inf), limits.discharge_a),
        min(pack.max_charge_a or np.inf, alarms.get("charge_over_current", np.inf), limits.charge_a),
        alarms.get("charging_below_freezing", -np.inf),
        limits.unseen_discharge_a if pack.max_discharge_a is None else np.inf,
        limits.unseen_charge_a if pack.max_charge_a is None else np.inf,
    )


def known_power_w(states: list[Records], settings: Record, duration_s: float, limit_v: float, max_a: float) -> float:
    """Return the 5 % quantile of the available power [W]; NaN if it is unknown because of the SOC.

    It is unknown if the quantile is below half the median, and would be above half of it with a known SOC.

    Args:
        states: States of the filter, each of shape (1,), dtype EKF_STATE. The one with the least power counts.
        settings: Record of EKF_SETTINGS.
        duration_s: Duration of the power [s].
        limit_v: Voltage that must not be crossed [V].
        max_a: Largest current [A]; positive: discharge, negative: charge.
    """
    scratch = new_scratch()

    def quantile_and_median(states: list[Records]) -> list[float]:
        return [
            min(available_power(s[0], settings, duration_s, limit_v, max_a, stds, scratch) for s in states)
            for stds in (QUANTILE_STDS, 0.0)
        ]

    power_w, median_w = quantile_and_median(states)
    if power_w >= MIN_QUANTILE_RATIO * median_w:
        return power_w
    known_w, known_median_w = quantile_and_median([with_known_soc(s) for s in states])
    return math.nan if known_w >= MIN_QUANTILE_RATIO * known_median_w else power_w


def with_known_soc(state: Records) -> Records:
    """Return a copy of a state of the filter under the condition that the SOC is that of its most likely hypothesis.

    Args:
        state: Shape (1,), dtype EKF_STATE; read only.
    """
    known = state.copy()
    row = known[0]
    best = int(row["best"])
    row["ln_weight"][np.arange(row["ln_weight"].size) != best] = -np.inf
    covariance = row["covariance"][best]
    covariance -= np.outer(covariance[:, SOC], covariance[SOC]) / covariance[SOC, SOC]
    covariance[SOC] = covariance[:, SOC] = 0.0  # a negative rounding error would have no square root
    return known


@dataclass(frozen=True)
class PresentPower:
    """Means over a publish window, and the temperature after it.

    Attributes:
        voltage_v: Terminal voltage [V].
        current_a: Current [A], positive on discharge.
        power_w: Power [W], positive on discharge.
        temperature_c: Temperature of the cells [C].
    """

    voltage_v: float
    current_a: float
    power_w: float
    temperature_c: float


def raise_to_present(values: ForecastRows, present: PresentPower, limits: PowerLimits, cutoff_v: float) -> None:
    """Raise the available power to the power that the pack supplies or accepts now.

    A current above its limit counts as the limit. At the cut-off voltage the discharge power is not raised, because the pack
    cannot continue to supply it. At the full voltage the charge power is raised, because the charger holds this voltage. NaN
    remains NaN.

    Args:
        values: Shape (1,), dtype ``FORECAST``; written.
        present: Present power of the pack.
        limits: Limits of current and temperature.
        cutoff_v: Terminal voltage at which the load is switched off [V].
    """
    if present.current_a > 0.0 and present.voltage_v > cutoff_v:
        direction, max_a = "discharge", limits.discharge_a
    elif present.current_a < 0.0:
        direction, max_a = "charge", limits.charge_limit_a(present.temperature_c)
    else:
        return
    power_w = abs(present.power_w) * min(1.0, max_a / abs(present.current_a))
    for duration_s in DURATIONS_S:
        name = f"available_{direction}_power_{duration_s:.0f}s_w"
        values[name] = np.maximum(values[name], power_w)
