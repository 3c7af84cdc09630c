"""Alarms on estimates: SOC, stability margin, model, time to the cut-off, and single cells."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import ForecastRows
from bms_estimator.kernels.accumulators.soc_certainty import known_rows
from bms_estimator.kernels.alarms import CELLS_GAP_S
from bms_estimator.model.arrays import Floats
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.alarm_list import AlarmList
from bms_estimator.telemetry.alarms.sample_intervals import SampleIntervals
from bms_estimator.telemetry.cells import NO_CELL_FAULT, CellFault, CellFaults
from bms_estimator.telemetry.state import UNKNOWN_SOC, known_margin, missing_margin_reason


class CellAlarms:
    """Alarms ``cell_short``, ``cell_sensor_fault`` and ``weak_cell``.

    Args:
        alarms: All alarms of the pack; the three are updated.
    """

    def __init__(self, alarms: AlarmList) -> None:
        self._alarms = alarms
        self._weak_cell_intervals = SampleIntervals(math.inf)  # no interval is a gap, because a weak cell remains weak
        self._cell_intervals = SampleIntervals(CELLS_GAP_S)
        self._described: dict[AlarmName, CellFault] = {}  # fault that the text of an alarm describes

    def evaluate_weak_cell(self, deviation_std: float, at_s: float, wall_offset_s: float) -> None:
        """Evaluate the alarm ``weak_cell``.

        Args:
            deviation_std: Deviation of the last discharge from the bank's reference [std].
            at_s: Time of the last sample [s].
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        time_s = np.array([at_s])
        _, observed_s = self._weak_cell_intervals.measure(time_s)
        self._alarms.update("weak_cell", time_s, observed_s, np.array([deviation_std]), wall_offset_s)

    def evaluate(self, faults: CellFaults, wall_offset_s: float) -> None:
        """Evaluate the alarms on faults of single cells.

        Args:
            faults: Faults at the last sample.
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        times_s = np.array([faults.at_s])
        _, observed_s = self._cell_intervals.measure(times_s)
        values: dict[AlarmName, CellFault] = {"cell_short": faults.short, "cell_sensor_fault": faults.reading}
        for name, fault in values.items():
            state = self._alarms.states.get(name)
            # the text of a raised alarm changes only with the kinds of its faults, because its numbers change often
            described = self._described.get(name, NO_CELL_FAULT)
            if state is not None and (state.raised is None or (fault.kinds and fault.kinds != described.kinds)):
                self._alarms.set_reasons(name, *fault.texts)
                self._described[name] = fault
            self._alarms.update(name, times_s, observed_s, np.array([fault.value]), wall_offset_s)


MODEL_SUSPECTS = InputFault.CAPACITY | InputFault.OCV
"""Input faults that raise ``model_mismatch``."""


class EstimateAlarms:
    """Alarms on estimates.

    Args:
        alarms: All alarms of the pack; those on estimates are updated.
        charging_a: Minimum current into the pack that counts as charging [A].
        gap_s: Minimum length of a gap between samples [s].
    """

    def __init__(self, alarms: AlarmList, charging_a: float, gap_s: float) -> None:
        self._alarms, self._charging_a, self._intervals = alarms, charging_a, SampleIntervals(gap_s)
        self._mismatch_suspected = False
        self._soc_known = False  # True if the SOC was known at the last row of the trace

    def evaluate(self, trace: TraceBlock, forecasts: ForecastRows, suspects: InputFault, wall_offset_s: float) -> None:
        """Evaluate the alarms on estimates.

        Args:
            trace: Shape (n,), dtype TRACE.
            forecasts: Forecast at each row of the trace, shape (n,), dtype FORECAST.
            suspects: Input faults that the filter suspects now.
            wall_offset_s: Wall clock minus the samples' clock [s].
        """
        times_s = trace["time_s"]
        _, observed_s = self._intervals.measure(times_s)
        is_mismatch = (trace["lock"] == 0) | self._mismatch_suspected
        self._mismatch_suspected = bool(suspects & MODEL_SUSPECTS)
        # a new suspicion counts from the last sample on, because its start is unknown
        is_mismatch[-1] |= self._mismatch_suspected
        soc_known = known_rows(trace, self._soc_known)
        self._soc_known = bool(soc_known[-1])
        self._alarms.set_unknown(find_unknown(trace[-1], soc_known=self._soc_known))
        for name, series in estimated_values(trace, is_mismatch, soc_known).items():
            self._alarms.update(name, times_s, observed_s, series, wall_offset_s)
        risks = collapse_risks(forecasts, trace["current_a"] <= -self._charging_a)

        def reason_at(at_s: float) -> str:
            return time_left_text(forecasts[int(np.flatnonzero(times_s == at_s)[-1])])

        self._alarms.update("collapse_risk", times_s, observed_s, risks, wall_offset_s, reason_at)


def estimated_values(
    trace: TraceBlock, is_mismatch: NDArray[np.bool_], soc_known: NDArray[np.bool_]
) -> dict[AlarmName, Floats]:
    """Return the values of the alarms on estimates, each of shape (n,). Values that need an unknown SOC are NaN.

    Without a margin, ``stability_margin_low`` has an infinite value, which ends an alarm that an earlier margin raised.

    Args:
        trace: Shape (n,), dtype TRACE.
        is_mismatch: True where the filter suspects a wrong cell model, or the observer is out of lock; shape (n,).
        soc_known: True where the SOC is known, shape (n,).
    """
    std, has_margin = trace["soc_std"], ~np.isnan(trace["stability_margin"]) | np.isnan(trace["soc"])
    return {
        "soc_low": np.where(soc_known, trace["soc"] - np.where(np.isnan(std), 0.0, std), np.nan),
        "stability_margin_low": np.where(has_margin, known_margin(trace, soc_known), np.inf),
        "model_mismatch": np.where(is_mismatch, np.inf, np.abs(trace["innovation_v"])),
    }


def find_unknown(row: np.void, *, soc_known: bool) -> dict[AlarmName, str]:
    """Return the alarms whose value is not known although the quantities that they need are measured, each with the reason.

    A fuel cell has no such alarm, because it has no SOC. The probability of ``collapse_risk`` includes the uncertainty of the SOC.

    Args:
        row: The last estimate, dtype TRACE.
        soc_known: True if its SOC is known.
    """
    if math.isnan(row["soc"]):
        return {}
    reasons: dict[AlarmName, str | None] = {
        "soc_low": None if soc_known else UNKNOWN_SOC,
        "stability_margin_low": missing_margin_reason(row, soc_known=soc_known),
    }
    return {name: reason for name, reason in reasons.items() if reason}


def collapse_risks(forecasts: ForecastRows, is_charging: np.ndarray) -> Floats:
    """Return the value of the alarm ``collapse_risk`` at each forecast, shape (n,), 0..1.

    It is the probability of the cut-off within 5 min. Without a forecast it is 0 during a charge, and otherwise NaN.

    Args:
        forecasts: Forecasts, shape (n,), dtype FORECAST.
        is_charging: True at samples with a charge current, shape (n,).
    """
    probability: Floats = forecasts["cutoff_within_5min"]
    return np.where(np.isnan(probability) & is_charging, 0.0, probability)


def time_left_text(forecast: np.void) -> str:
    """Return a sentence with the 90 % band of the time to the cut-off, from a record of FORECAST."""
    early_min, late_min = (float(forecast[f"time_to_cutoff_{name}_s"]) / 60.0 for name in ("p05", "p95"))
    return f"the time left was {early_min:.0f} to {late_min:.0f} min (90 % band) when the alarm was raised"
