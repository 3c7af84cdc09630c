"""Summary of a replay, for tables and JSON."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.kernels.accumulators.publish_window import known_rows
from bms_estimator.pack.pack import Pack
from bms_estimator.telemetry.cells import CELL_COLUMNS, make_cells_payload, weakest_by_cells, weakest_cell_fields
from bms_estimator.telemetry.health import sample_counters, suspicions
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.state import finite, known_margin, missing_margin_reason


@dataclass(frozen=True)
class LearnedParameter:
    """Value of a learned parameter at the end of a replay; None for missing numbers."""

    value: float | None
    std: float | None
    valid: bool


@dataclass(frozen=True)
class ReplayResult:
    """Result of a replay; None for missing numbers."""

    samples: int
    """Number of accepted samples."""
    duration_s: float | None
    """Time from the first to the last accepted sample, on the capture's clock."""
    soc_initial: float | None
    soc_final: float | None
    soc_std_final: float | None
    """Standard deviation that the identifier estimates; None if the identifier is off."""
    soc_rms_difference_to_coulomb: float | None
    innovation_rms_v: float | None
    """RMS of measured minus predicted voltage, before the correction by the measurement; without the identifier, the observer's."""
    tracking_error_rms_v: float | None
    """RMS of the observer's tracking error e, (3.15)."""
    lock_lost: bool
    """True if the observer lost its lock."""
    lock_losses: int
    k_final: float | None
    """Adaptive gain of the observer at the end [V²s]."""
    temperature_sensor: bool
    """True if the capture has the cell's temperature."""
    suspects: list[str]
    """Input diagnostics of the identifier at the end."""
    gain_rearms: int
    """Number of resets of the observer's gain k (setting ``observer.rearm_gain``)."""
    dropped: dict[str, int]
    """Number of dropped samples by kind of fault."""
    impossible: str | None
    """Description of the last sample outside the cell's limits, with the likely cause."""
    temperatures_dropped: int
    """Number of implausible temperatures."""
    gaps: int
    time_steps_back: int
    """Number of samples with a timestamp before the previous sample's."""
    parameters: dict[str, LearnedParameter]
    """Parameters of a fuel cell by the keys of its file; a1..a21 of the observer for a battery."""
    delta_1: float | None
    """SOC below which C_ts is negative, (2.11); None for a fuel cell."""
    delta_2: float | None
    """SOC below which C_tl is negative, (2.12)."""
    stability_margin: float | None
    """SOC at the end minus the larger of both deltas; None if ``stability_margin_reason`` is set, and for a fuel cell."""
    stability_margin_std: float | None
    stability_margin_reason: str | None
    capacity_ah: float | None
    """Learned capacity at the end [Ah]; None without the identifier."""
    capacity_std_ah: float | None
    """Standard deviation of the learned capacity [Ah]."""
    fits: int
    """Number of adopted fits of the pack's model."""
    failed_fits: int
    """Number of fits that ended with an error."""
    forecast: dict[str, float | None]
    """Values of a forecast from the last sample; empty without a forecaster."""
    forecast_reason: str | None
    """Reason why ``forecast`` has no time to the cut-off; None if it has one, or without a forecaster."""
    weakest_cell: int | None
    """Number of the cell with the lowest SOC at the end, from 1; None without cell voltages."""
    weakest_cell_soc: float | None
    """SOC of the weakest cell, 0..1."""
    weakest_cell_soc_std: float | None
    cell_soc_spread: float | None
    """Highest less lowest SOC of the cells."""
    cell_r_spread: float | None
    """Highest less lowest resistance of the cells, relative to the median."""
    cells: list[dict[str, Any]]
    """Cells in series at the end, with the fields of ``CellReport``; empty without cell voltages."""
    samples_per_s: float | None
    """Number of processed samples per second, including dropped samples."""
    wall_s: float
    """Duration of the replay [s]."""


class Summary:
    """Accumulator of sums over blocks of a trace, which has one row of estimates for each accepted sample."""

    def __init__(self) -> None:
        self._row_count = 0
        self._first: np.void | None = None
        self._last: np.void | None = None
        self._duration_s = 0.0
        self._soc_known = False  # True if the SOC was known at the last row
        # sums of squares
        self._innovation_sum = self._tracking_sum = self._soc_difference_sum = 0.0

    def add(self, trace: NDArray[np.void]) -> None:
        """Add a block of dtype TRACE."""
        if trace.size == 0:
            return
        if self._first is None:
            self._first = trace[0].copy()
        previous_s = trace["time_s"][0] if self._last is None else self._last["time_s"]
        # a step back of the clock counts as 0 s
        self._duration_s += float(np.diff(trace["time_s"], prepend=previous_s).clip(min=0.0).sum())
        self._last = trace[-1].copy()
        self._soc_known = bool(known_rows(trace, self._soc_known)[-1])
        self._row_count += trace.size
        # not by @, because BLAS would use several threads for these sums, and wait for them on a busy machine
        self._innovation_sum += float(np.square(trace["innovation_v"]).sum())
        self._tracking_sum += float(np.square(trace["tracking_error_v"]).sum())
        self._soc_difference_sum += float(np.square(trace["soc"] - trace["soc_coulomb"]).sum())

    def result(self, pack: Pack, short_limit_a: float, sample_count: int, wall_s: float) -> ReplayResult:
        """Return the result of the replay, without ``impossible`` and ``temperatures_dropped``, which the caller sets.

        Args:
            pack: The pack after the last sample.
            short_limit_a: Limit of the alarm ``cell_short`` [A].
            sample_count: Number of samples in the capture, including dropped samples.
            wall_s: Duration of the replay [s].
        """
        estimator, slow_fit = pack.estimator, pack.slow_fit
        record, settings = estimator.record[0], estimator.settings_record[0]
        observer = record["observer"]
        counters = sample_counters(observer)
        identified = estimator.has_filter and bool(observer["started"])
        declared_ah = float(estimator.settings["capacity_as"][0]) / 3600.0
        capacity = relative_capacity(record) if identified else None
        return ReplayResult(
            samples=self._row_count,
            duration_s=self._duration_s if self._row_count else None,
            soc_initial=_finite_field(self._first, "soc"),
            soc_final=_finite_field(self._last, "soc"),
            soc_std_final=_finite_field(self._last, "soc_std"),
            soc_rms_difference_to_coulomb=self._rms(self._soc_difference_sum),
            innovation_rms_v=self._rms(self._innovation_sum),
            tracking_error_rms_v=self._rms(self._tracking_sum),
            lock_lost=bool(observer["lock_losses"]),
            lock_losses=int(observer["lock_losses"]),
            k_final=finite(observer["k"]),
            temperature_sensor=bool(record["filter"]["sensed"]),
            suspects=suspicions(record, settings),
            gain_rearms=int(observer["gain_rearms"]),
            dropped={
                name.removeprefix("dropped_"): count for name, count in counters.items() if name.startswith("dropped_")
            },
            impossible=None,
            temperatures_dropped=0,
            gaps=counters["gaps"],
            time_steps_back=counters["time_steps_back"],
            parameters=_learned_parameters(estimator),
            delta_1=_finite_field(self._last, "delta_1"),
            delta_2=_finite_field(self._last, "delta_2"),
            **self._margin_fields(),
            capacity_ah=capacity.value * declared_ah if capacity else None,
            capacity_std_ah=capacity.std * declared_ah if capacity else None,
            fits=slow_fit.fits if slow_fit else 0,
            failed_fits=slow_fit.failed if slow_fit else 0,
            **_last_forecast(pack.forecaster),
            **_last_cells(pack.cells.deviations if pack.cells else None, short_limit_a),
            samples_per_s=sample_count / wall_s if wall_s > 0.0 else None,
            wall_s=wall_s,
        )

    def _margin_fields(self) -> dict[str, Any]:
        """Return the fields of ``ReplayResult`` with the stability margin at the last row."""
        if self._last is None:
            return dict.fromkeys(("stability_margin", "stability_margin_std", "stability_margin_reason"))
        margin = finite(known_margin(self._last, self._soc_known))
        return {
            "stability_margin": margin,
            "stability_margin_std": None if margin is None else finite(self._last["stability_margin_std"]),
            "stability_margin_reason": missing_margin_reason(self._last, soc_known=self._soc_known),
        }

    def _rms(self, sum_of_squares: float) -> float | None:
        return finite(math.sqrt(sum_of_squares / self._row_count)) if self._row_count else None


def _learned_parameters(estimator: Estimator) -> dict[str, LearnedParameter]:
    """Return the parameters of a fuel cell, or a1..a21 of a battery; empty before the first sample."""
    if not estimator.state[0]["started"]:
        return {}
    report = make_parameters_payload(estimator, now_s=0.0)  # the time is not part of the result
    return {name: LearnedParameter(p.value, p.std, p.valid) for name, p in (report.a or report.elements).items()}


def _last_forecast(forecaster: Forecaster | None) -> dict[str, Any]:
    """Return the fields of ``ReplayResult`` with a forecast from the last sample."""
    if forecaster is None:
        return {"forecast": {}, "forecast_reason": None}
    forecast = forecaster.forecast()
    values = {name: finite(forecast.values[0][name]) for name in forecast.values.dtype.names or ()}
    return {"forecast": values, "forecast_reason": forecast.reason}


def _last_cells(deviations: CellDeviations | None, short_limit_a: float) -> dict[str, Any]:
    """Return the fields of ``ReplayResult`` with the cells in series."""
    if deviations is None:
        return {**dict.fromkeys(CELL_COLUMNS.names or ()), "cells": []}
    report = make_cells_payload(deviations, short_limit_a, now_s=0.0)  # the time is not part of the result
    return {**weakest_cell_fields(weakest_by_cells(deviations)), "cells": [cell.model_dump() for cell in report.cells]}


def _finite_field(row: np.void | None, name: str) -> float | None:
    return None if row is None else finite(row[name])
