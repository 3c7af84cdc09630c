"""Summary of a replay, for tables and JSON."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.model.fuel_cell import FuelCellModel
from bms_estimator.telemetry.fuel_cell_parameters import fuel_cell_parameters
from bms_estimator.telemetry.health import sample_counters, suspicions
from bms_estimator.telemetry.state import finite


@dataclass(frozen=True)
class LearnedParameter:
    """Parameter learned at the end of a replay; None for missing numbers."""

    value: float | None
    std: float | None
    valid: bool


@dataclass(frozen=True)
class Result:
    """Result of a replay; None for missing numbers."""

    samples: int
    """Number of accepted samples."""
    duration_s: float | None
    """Time from the first to the last accepted sample, on the capture's clock."""
    soc_initial: float | None
    soc_final: float | None
    soc_std_final: float | None
    """Standard deviation by the identifier; None without it."""
    soc_rms_difference_to_coulomb: float | None
    innovation_rms_v: float | None
    """RMS of measured minus predicted voltage, before the correction by the measurement."""
    voltage_rms_error_v: float | None
    """RMS of measured minus estimated voltage, after the correction by the measurement."""
    lock_lost: bool
    lock_losses: int
    k_final: float | None
    temperature_sensor: bool
    """True if the capture has the cell's temperature."""
    suspects: list[str]
    """Input diagnostics of the identifier at the end."""
    gain_rearms: int
    dropped: dict[str, int]
    """Number of dropped samples by kind of fault."""
    impossible: str | None
    """Description of the last sample outside the cell's limits, with the likely cause."""
    temperatures_dropped: int
    """Number of implausible temperatures."""
    gaps: int
    time_steps_back: int
    parameters: dict[str, LearnedParameter]
    """Parameters of a fuel cell by the keys of its file; empty for a battery, whose parameters depend on SOC."""
    samples_per_s: float | None
    """Number of processed samples per second, including dropped samples."""
    wall_s: float
    """Duration of the replay [s]."""


class Summary:
    """Accumulator of sums over trace blocks."""

    def __init__(self) -> None:
        self._rows = 0
        self._first: np.void | None = None
        self._last: np.void | None = None
        self._duration_s = 0.0
        self._innovation = self._error = self._soc_difference = 0.0

    def add(self, trace: NDArray[np.void]) -> None:
        """Add a block of dtype TRACE."""
        if trace.size == 0:
            return
        if self._first is None:
            self._first = trace[0].copy()
        before_s = trace["time_s"][0] if self._last is None else self._last["time_s"]
        self._duration_s += float(np.diff(trace["time_s"], prepend=before_s).clip(min=0.0).sum())
        self._last = trace[-1].copy()
        self._rows += trace.size
        error = trace["voltage_v"] - trace["voltage_estimate_v"]
        self._innovation += float(trace["innovation_v"] @ trace["innovation_v"])
        self._error += float(error @ error)
        difference = trace["soc"] - trace["soc_coulomb"]
        self._soc_difference += float(difference @ difference)

    def result(self, estimator: Estimator, read: int, wall_s: float) -> Result:
        """Return the result of the replay.

        Args:
            estimator: Estimator after the last sample.
            read: Number of samples in the capture.
            wall_s: Duration of the replay [s].
        """
        record, settings = estimator.record[0], estimator.settings_record[0]
        state = record["observer"]
        counters = sample_counters(state)
        return Result(
            samples=self._rows,
            duration_s=self._duration_s if self._rows else None,
            soc_initial=_field(self._first, "soc"),
            soc_final=_field(self._last, "soc"),
            soc_std_final=_field(self._last, "soc_std"),
            soc_rms_difference_to_coulomb=self._rms(self._soc_difference),
            innovation_rms_v=self._rms(self._innovation),
            voltage_rms_error_v=self._rms(self._error),
            lock_lost=bool(state["lock_losses"]),
            lock_losses=int(state["lock_losses"]),
            k_final=finite(state["k"]),
            temperature_sensor=bool(record["filter"]["sensed"]),
            suspects=suspicions(record, settings),
            gain_rearms=int(state["gain_rearms"]),
            dropped={
                name.removeprefix("dropped_"): count for name, count in counters.items() if name.startswith("dropped_")
            },
            impossible=None,
            temperatures_dropped=0,
            gaps=counters["gaps"],
            time_steps_back=counters["time_steps_back"],
            parameters=_learned(estimator),
            samples_per_s=read / wall_s if wall_s > 0.0 else None,
            wall_s=wall_s,
        )

    def _rms(self, squares: float) -> float | None:
        return finite(math.sqrt(squares / self._rows)) if self._rows else None


def _learned(estimator: Estimator) -> dict[str, LearnedParameter]:
    if not isinstance(estimator.cell, FuelCellModel) or not estimator.state[0]["started"]:
        return {}
    parameters = fuel_cell_parameters(estimator, 0.0)
    return {name: LearnedParameter(p.value, p.std, p.valid) for name, p in parameters.items()}


def _field(row: np.void | None, name: str) -> float | None:
    return None if row is None else finite(row[name])
