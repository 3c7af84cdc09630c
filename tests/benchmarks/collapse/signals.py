"""Signals of a coming cut-off, every ten seconds of a discharge."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.model.arrays import Floats
from tests.benchmarks.collapse.drives import Recording

STEP_S, MAX_STEP_S = 10.0, 60.0
"""Time between two rows [s], and the longest time between two samples that is no gap [s]."""
LOWEST_S, TREND_S, GAIN_S, USE_S = 600.0, 60.0, 60.0, 900.0
"""Duration of the windows of the lowest voltage, dV/dt, the gain activity, and of the load that counts as use [s]."""
MIN_USE_C = 0.02
"""Minimum mean current of ``USE_S`` that counts as use, as a C-rate [1/h]."""
MIN_CHARGE = 0.05
"""Minimum charge between two discharges, and minimum discharge, as a fraction of the capacity. Regeneration is less."""
NEVER_S = 1e6
"""Extrapolated time to the cut-off if the voltage does not fall [s]."""
BLOCK = 100_000
"""Number of samples between two copies of the trace."""
SIGNALS = np.dtype(
    [
        ("time_s", "f8"),
        ("soc", "f8"),
        ("within_2min", "f8"),  # probability of the forecast, 0..1
        ("within_5min", "f8"),
        ("within_15min", "f8"),
        ("lowest_v", "f8"),  # lowest cell voltage of LOWEST_S above the cut-off [V]
        ("extrapolated_s", "f8"),  # time to the cut-off by dV/dt over TREND_S [s]
        ("gain_rate", "f8"),  # increase of the observer's k over GAIN_S (3.13) [V^2]
        ("error_v", "f8"),  # mean |e| of the observer over GAIN_S (3.15) [V]
        ("margin", "f8"),  # SOC minus max(delta_1, delta_2)
        ("p05_s", "f8"),  # 5 % quantile of the time to the cut-off [s]
        ("p50_s", "f8"),
    ]
)
"""Signals at one time."""


@dataclass(frozen=True)
class Discharge:
    """Rows of one discharge until the cut-off or the next charge.

    Attributes:
        name: Name of the recording.
        rows: Shape (n,), dtype ``SIGNALS``.
        use_h: Time with load [h].
        cutoff_s: Time at which the voltage reached the cut-off [s]; NaN if it did not.
        cutoff_v: Cut-off voltage [V].
        is_simulated: True if the cell is simulated.
    """

    name: str
    rows: np.ndarray
    use_h: float
    cutoff_s: float
    cutoff_v: float
    is_simulated: bool


def discharges(recording: Recording, cutoff_v: float) -> Iterator[Discharge]:
    """Yield the discharges of a recording, with the forecast for one cut-off voltage."""
    trace, forecast = run(recording, cutoff_v)
    time_s = np.ascontiguousarray(trace["time_s"])
    last = np.flatnonzero(np.diff(np.floor(time_s / STEP_S), append=math.inf) > 0.0)
    rows = signal_rows(trace, forecast, last, cutoff_v)
    one_c = recording.cell.cell.capacity_ah
    is_use = window_mean(time_s, trace["current_a"], last, USE_S) > MIN_USE_C * one_c
    drawn = charge_drawn_ah(time_s, trace["current_a"])[last] / one_c
    for start, end in discharge_ranges(drawn.tolist()):
        first, stop = last[start], last[end - 1] + 1
        below = np.flatnonzero(trace["voltage_v"][first:stop] < cutoff_v)
        cutoff_s = float(time_s[first + below[0]]) if below.size else math.nan
        until = start + int(np.searchsorted(rows["time_s"][start:end], cutoff_s)) if below.size else end
        steps_s = np.minimum(np.diff(rows["time_s"][start:until], prepend=time_s[first]), MAX_STEP_S)
        use_h = float(steps_s @ is_use[start:until]) / 3600.0
        if use_h > 0.0:
            yield Discharge(recording.name, rows[start:until], use_h, cutoff_s, cutoff_v, recording.is_simulated)


def run(recording: Recording, cutoff_v: float) -> tuple[TraceBlock, np.ndarray]:
    """Return the trace of a recording, and the forecast at each of its rows."""
    estimator = Estimator(recording.cell)
    forecaster = Forecaster(estimator, estimator, cutoff_v=cutoff_v)
    parts = []
    for begin in range(0, recording.samples.size, BLOCK):
        trace = forecaster.run(recording.samples[begin : begin + BLOCK]).copy()
        parts.append((trace, forecaster.rows.copy()))
    traces, forecasts = zip(*parts, strict=True)
    return np.concatenate(traces), np.concatenate(forecasts)


def signal_rows(trace: TraceBlock, forecast: np.ndarray, last: np.ndarray, cutoff_v: float) -> np.ndarray:
    """Return the signals at the samples ``last``, dtype ``SIGNALS``."""
    # contiguous copies, because a search in a strided column copies the whole column
    time_s, voltage_v, k, error_v = (
        np.ascontiguousarray(trace[name]) for name in ("time_s", "voltage_v", "k", "tracking_error_v")
    )
    rows = np.zeros(last.size, SIGNALS)
    rows["time_s"], rows["soc"] = time_s[last], trace["soc"][last]
    rows["margin"] = rows["soc"] - np.maximum(trace["delta_1"][last], trace["delta_2"][last])
    rows["within_2min"] = forecast["cutoff_within_2min"][last]
    rows["within_5min"] = forecast["cutoff_within_5min"][last]
    rows["within_15min"] = forecast["cutoff_within_15min"][last]
    rows["p05_s"], rows["p50_s"] = forecast["time_to_cutoff_p05_s"][last], forecast["time_to_cutoff_s"][last]
    begins = {window_s: np.searchsorted(time_s, time_s[last] - window_s) for window_s in (LOWEST_S, TREND_S, GAIN_S)}
    for n, end in enumerate(last):
        begin = begins[LOWEST_S][n]
        rows["lowest_v"][n] = voltage_v[begin : end + 1].min() - cutoff_v
        begin = begins[TREND_S][n]
        rows["extrapolated_s"][n] = extrapolate(time_s[begin : end + 1], voltage_v[begin : end + 1], cutoff_v)
        begin = begins[GAIN_S][n]
        rows["gain_rate"][n] = np.clip(np.diff(k[begin : end + 1]), 0.0, None).sum()
        rows["error_v"][n] = np.abs(error_v[begin : end + 1]).mean()
    return rows


def extrapolate(time_s: Floats, voltage_v: Floats, cutoff_v: float) -> float:
    """Return the time after which a straight line through the voltages reaches the cut-off [s]."""
    if time_s.size < 3 or time_s[-1] <= time_s[0]:
        return NEVER_S
    elapsed_s = time_s - time_s.mean()
    slope = float(elapsed_s @ voltage_v / (elapsed_s @ elapsed_s))
    now_v = float(voltage_v.mean()) + slope * float(elapsed_s[-1])
    return min((now_v - cutoff_v) / -slope, NEVER_S) if slope < 0.0 else NEVER_S


def charge_drawn_ah(time_s: Floats, current_a: Floats) -> Floats:
    """Return the charge drawn until each sample [Ah]. The current is constant until the next sample; gaps do not count."""
    steps_s = np.diff(time_s)
    steps_s = np.where((steps_s > 0.0) & (steps_s < USE_S), steps_s, 0.0)
    return np.concatenate(([0.0], np.cumsum(current_a[:-1] * steps_s))) / 3600.0


def discharge_ranges(drawn: list[float]) -> Iterator[tuple[int, int]]:
    """Yield first and last index plus one of each discharge, from the charge drawn over the capacity at each row."""
    is_discharge, start, extreme = (
        True,
        0,
        0,
    )  # ``extreme``: row with the largest (smallest) charge drawn of a discharge (charge)
    for n, value in enumerate(drawn):
        beyond = value - drawn[extreme] if is_discharge else drawn[extreme] - value
        if beyond >= 0.0:
            extreme = n
        elif beyond < -MIN_CHARGE:
            if is_discharge:
                yield start, extreme + 1
            is_discharge, start, extreme = not is_discharge, extreme, n
    if is_discharge:
        yield start, len(drawn)


def window_mean(time_s: Floats, values: Floats, last: np.ndarray, window_s: float) -> Floats:
    """Return the mean over time of a signal in the window before each sample ``last``."""
    steps_s = np.clip(np.diff(time_s, prepend=time_s[0]), 0.0, window_s)
    integral = np.cumsum(steps_s * values)
    at = np.interp(time_s[last] - window_s, time_s, integral, left=0.0)
    mean: Floats = (integral[last] - at) / window_s
    return mean
