"""Estimator step for one sample (``step``) and for a block of samples (``run``).

(4.2) and (7.1) are equations of the thesis.
"""

import math
from enum import IntEnum

from bms_estimator.kernels.accumulators.history import needs_caller
from bms_estimator.kernels.cell_model.chen_mora import soc_from_ocv
from bms_estimator.kernels.current_check import accept_waiting, is_doubtful, max_step, set_reference
from bms_estimator.kernels.identifier import identifier_step, is_delta_configured, margin_with_std
from bms_estimator.kernels.kalman_filter.equivalent_circuit import (
    R_S,
    R_TL,
    R_TS,
    TAU_TL,
    TAU_TS,
    VARYING,
    open_circuit,
)
from bms_estimator.kernels.kalman_filter.hypotheses import weakest_cell_soc_std
from bms_estimator.kernels.kalman_filter.window import widen_by_interpolation
from bms_estimator.kernels.observer.learning_law import learning_step
from bms_estimator.kernels.observer.observer import count_charge, initialize, observer_step
from bms_estimator.kernels.observer.series_resistance import (
    series_resistance,
    series_resistance_step,
)
from bms_estimator.kernels.start import initialize_state, plausible_temperature, restart_after_unknown_gap
from bms_estimator.model.arrays import Record, Records, SampleStatus
from bms_estimator.numba_cache import njit


class SampleOutcome(IntEnum):
    """Outcome of a sample: accepted, or the reason for its rejection."""

    ACCEPTED = 0
    NOT_FINITE = 1
    OUT_OF_RANGE = 2
    REPEATED = 3
    SATURATED = 4
    CONTRADICTED = 5


# constants of the compiled functions, plain integers
_ACCEPTED = int(SampleOutcome.ACCEPTED)
_NOT_FINITE = int(SampleOutcome.NOT_FINITE)
_OUT_OF_RANGE = int(SampleOutcome.OUT_OF_RANGE)
_REPEATED = int(SampleOutcome.REPEATED)
_SATURATED = int(SampleOutcome.SATURATED)
_CONTRADICTED = int(SampleOutcome.CONTRADICTED)
_SATURATED_BITS = int(SampleStatus.VOLTAGE_SATURATED | SampleStatus.CURRENT_SATURATED)
MAX_TIME_S = 1e30
"""Maximum magnitude of a time stamp [s]. The squares of longer gaps could overflow."""
_VOLTAGE_HELD = int(SampleStatus.VOLTAGE_HELD)
_CURRENT_HELD = int(SampleStatus.CURRENT_HELD)


@njit(cache=True)
def validate_sample(s: Record, p: Record, time_s: float, current_a: float, voltage_v: float, status: int) -> int:
    """Return the outcome of a sample, and count rejected samples by reason.

    ``s`` is a record of OBSERVER_STATE, ``p`` of OBSERVER_SETTINGS.
    """
    if not (math.isfinite(time_s) and math.isfinite(current_a) and math.isfinite(voltage_v)):
        s.dropped_not_finite += 1
        return _NOT_FINITE
    if status & _SATURATED_BITS:
        s.dropped_saturated += 1
        return _SATURATED
    in_range = p.voltage_min_v <= voltage_v <= p.voltage_max_v and abs(current_a) <= p.current_max_a
    if not in_range or abs(time_s) > MAX_TIME_S:
        s.dropped_range += 1
        return _OUT_OF_RANGE
    if s.started and time_s == s.time_s:
        s.dropped_repeated += 1
        return _REPEATED
    return _ACCEPTED


@njit(cache=True)
def process_sample(
    s: Record,
    p: Record,
    time_s: float,
    current_a: float,
    voltage_v: float,
    status: int,
    temperature_c: float,
) -> int:
    """Process one sample.

    A held voltage is not a measurement, so that only the current and the temperature of its sample are used. The first
    sample initializes the estimator with its voltage in any case. The observer of the thesis has the voltage as its only
    input, which it holds between measurements.

    A sample with a current that the voltage does not follow waits for the next ones (``current_check``). If they confirm it,
    it is used without its voltage.

    A sample with a held current is stored until the next measured current, from which the current at its time is interpolated.
    Of several such samples only the last one is stored.

    Args:
        s: Record of ESTIMATOR_STATE; updated in place.
        p: Record of ESTIMATOR_SETTINGS.
        time_s: Time stamp [s].
        current_a: Current [A], positive on discharge.
        voltage_v: Terminal voltage [V].
        status: Bits of ``SampleStatus``.
        temperature_c: Temperature of the cell [C]; NaN without a sensor.

    Returns:
        A ``SampleOutcome``.
    """
    o = s.observer
    outcome = validate_sample(o, p.observer, time_s, current_a, voltage_v, status)
    if outcome != _ACCEPTED:
        return outcome
    if is_doubtful(s, p.observer, time_s - o.time_s, current_a, voltage_v, status):
        return _CONTRADICTED
    o.samples += 1
    temperature_c = plausible_temperature(s.learning, temperature_c)
    if not o.started:
        set_reference(s.current_check, current_a, voltage_v, 0)
        initialize(o, p.observer, time_s, current_a, voltage_v)
        initialize_state(s, p, current_a, voltage_v, temperature_c)
        return outcome
    dt_s = time_s - o.time_s
    pending = s.pending
    if status & _CURRENT_HELD and dt_s > 0.0:
        if not status & _VOLTAGE_HELD:
            pending.age_s, pending.voltage_v = dt_s, voltage_v
        return outcome
    dt_s -= advance_to_waiting(s, p, dt_s, current_a, voltage_v, temperature_c)
    set_reference(s.current_check, current_a, voltage_v, status)
    pending_s, pending.age_s = pending.age_s, 0.0
    o.time_s = time_s
    new_clock = dt_s == -math.inf  # ``Estimator.resume`` has set the time of the last sample to infinity
    if new_clock:
        dt_s = s.unseen_s
        settle_s = p.learning.settle_s  # RC voltages are unknown, because the load in the gap is unknown
        s.learning.settle_s = s.series_resistance.settle_s = settle_s
    if not 0.0 <= dt_s < math.inf:  # the clock was set back, or the duration of the gap is unknown
        o.current_a = s.filter.current_a = current_a
        s.filter.step.phase = VARYING
        if new_clock:
            restart_after_unknown_gap(s, p, current_a, voltage_v, temperature_c)
        else:
            o.time_steps_back += 1
        return outcome
    gap = new_clock or is_gap(o, p.observer, dt_s)
    measured_v = math.nan if status & _VOLTAGE_HELD else voltage_v
    if 0.0 < pending_s < dt_s and not gap:
        change_a = current_a - o.current_a
        pending_a = o.current_a + pending_s / dt_s * change_a
        widen_by_interpolation(s.filter.window, change_a, pending_s, dt_s)
        advance(s, p, pending_s, False, pending_a, pending.voltage_v, pending.voltage_v, temperature_c)
        dt_s -= pending_s
    advance(s, p, dt_s, gap, current_a, measured_v, voltage_v, temperature_c)
    return outcome


@njit(cache=True)
def advance(
    s: Record,
    p: Record,
    dt_s: float,
    gap: bool,
    current_a: float,
    measured_v: float,
    voltage_v: float,
    temperature_c: float,
) -> None:
    """Advance all parts of the estimator by ``dt_s``.

    Args:
        s: Record of ESTIMATOR_STATE; updated in place.
        p: Record of ESTIMATOR_SETTINGS.
        dt_s: Time step [s].
        gap: True if samples are missing in the step.
        current_a: Current at the end of the step [A].
        measured_v: Voltage at the end of the step [V]; NaN if it was not measured.
        voltage_v: Last measured voltage [V].
        temperature_c: Temperature of the cell [C]; NaN without a sensor.
    """
    o = s.observer
    previous_a, previous_soc = o.current_a, o.soc
    count_charge(o, p.observer, dt_s, current_a)
    o.voltage_age_s += dt_s
    if p.identify:
        identifier_step(s, p, dt_s, gap, current_a, measured_v, temperature_c)
    else:
        o.soc = o.soc_coulomb
    if p.learning.enabled:
        learning_step(s, p, dt_s, previous_a, measured_v)
    else:
        observer_step(o, p.observer, dt_s, voltage_v)
    if p.series_resistance:
        series_resistance_step(s, p, dt_s, previous_a, previous_soc, measured_v)
    if math.isfinite(measured_v):
        o.voltage_age_s = 0.0


@njit(cache=True)
def advance_to_waiting(
    s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float, temperature_c: float
) -> float:
    """Advance to the samples that waited, if this sample confirms them. Return the time step to them [s]; 0 without any.

    Their voltages are not used, because they did not belong to their currents. Parameters are those of ``advance``.
    """
    if not accept_waiting(s, p.observer, dt_s, current_a, voltage_v):
        return 0.0
    d = s.current_check
    s.pending.age_s = 0.0
    advance(s, p, d.age_s, False, d.current_a, math.nan, d.voltage_v, temperature_c)
    return float(d.age_s)


@njit(cache=True)
def step(
    state: Records,
    settings: Records,
    time_s: float,
    current_a: float,
    voltage_v: float,
    status: int,
    temperature_c: float,
) -> int:
    """Process one sample and return its ``SampleOutcome``. The arrays are those of ``run``."""
    return process_sample(state[0], settings[0], time_s, current_a, voltage_v, status, temperature_c)


@njit(cache=True)
def is_gap(s: Record, p: Record, dt_s: float) -> bool:
    """Return True if samples are missing in a step of ``dt_s``, and count the gap.

    ``s`` is a record of OBSERVER_STATE, ``p`` of OBSERVER_SETTINGS.
    """
    gap = dt_s > max_step(s, p)
    s.step_s = dt_s
    if gap:
        s.gaps += 1
    return gap


@njit(cache=True)
def run(state: Records, settings: Records, samples: Records, trace: Records) -> tuple[int, int]:
    """Process a block of samples and write a row of ``trace`` for each accepted sample.

    The run ends early if the history's rows must be taken or its event is due (``history.needs_caller``).

    Args:
        state: Shape (1,), dtype ESTIMATOR_STATE; updated in place.
        settings: Shape (1,), dtype ESTIMATOR_SETTINGS.
        samples: Shape (n,), dtype SAMPLE.
        trace: Shape (m,) with m >= n, dtype TRACE; written from its start.

    Returns:
        Number of samples processed, and number of rows written to ``trace``.
    """
    s, p, rows = state[0], settings[0], 0
    for j in range(samples.shape[0]):
        x = samples[j]
        if process_sample(s, p, x.time_s, x.current_a, x.voltage_v, x.status, x.temperature_c) == _ACCEPTED:
            row = trace[rows]
            write_observer_trace(row, s.observer, p, x)
            write_filter_trace(row, s, p)
            write_margin(row, s, p)
            rows += 1
            if needs_caller(s.history):
                return j + 1, rows
    return samples.shape[0], rows


@njit(cache=True)
def write_observer_trace(row: Record, s: Record, p: Record, x: Record) -> None:
    """Write the observer's columns for an accepted sample ``x``.

    ``s`` is a record of OBSERVER_STATE, ``p`` of ESTIMATOR_SETTINGS.
    """
    row.time_s = x.time_s
    row.voltage_v = x.voltage_v
    row.current_a = x.current_a
    row.temperature_c = x.temperature_c
    row.soc = s.soc
    row.tracking_error_v = s.innovation_v
    row.nussbaum_gain = math.nan if p.learning.enabled else s.gain
    row.adaptation_gain_hz = s.gain if p.learning.enabled else math.nan
    row.k = s.k
    row.delta_1 = s.delta_1
    row.delta_2 = s.delta_2
    row.lock = s.lock
    row.converged = 1 if abs(s.innovation_v) < p.observer.epsilon_v else 0
    row.soc_coulomb = s.soc_coulomb


@njit(cache=True)
def write_filter_trace(row: Record, s: Record, p: Record) -> None:
    """Write the filter's columns. ``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.

    Without the filter, ``innovation_v`` and ``voltage_estimate_v`` are the observer's e and y^, ``r_s_ohm`` is R_s by (4.2)
    if enabled, and the other columns are NaN. ``soc_ocv`` is then NaN, because the observer's v_ts and v_tl absorb any error
    of the SOC, so that the inverted OCV (7.1) would return the observer's own SOC. It is also NaN with a held voltage or
    current, because voltage and current were not measured together.
    """
    if not p.identify:
        row.innovation_v, row.voltage_estimate_v = s.observer.innovation_v, s.observer.voltage_estimate_v
        row.soc_ocv = row.soc_std = math.nan
        row.r_s_ohm = series_resistance(s) if p.series_resistance else math.nan
        row.r_ts_ohm = row.tau_ts_s = row.r_tl_ohm = row.tau_tl_s = math.nan
        row.r_s_std_ohm = row.r_ts_std_ohm = row.tau_ts_std_s = row.r_tl_std_ohm = row.tau_tl_std_s = math.nan
        return
    f, e = s.filter, s.elements
    row.innovation_v, row.voltage_estimate_v = f.innovation_v, f.voltage_v
    row.soc_ocv = math.nan
    if s.observer.voltage_age_s == 0.0 and s.observer.time_s == row.time_s:
        e_o = open_circuit(f, p.filter, e, row.current_a, row.voltage_v)
        row.soc_ocv = soc_from_ocv(e_o, p.filter.ocv_v, p.filter.ocv_slope_v)
    row.soc_std = weakest_cell_soc_std(f, p.filter)
    row.r_s_ohm, row.r_s_std_ohm = value_and_std(e, R_S)
    row.r_ts_ohm, row.r_ts_std_ohm = value_and_std(e, R_TS)
    row.tau_ts_s, row.tau_ts_std_s = value_and_std(e, TAU_TS)
    row.r_tl_ohm, row.r_tl_std_ohm = value_and_std(e, R_TL)
    row.tau_tl_s, row.tau_tl_std_s = value_and_std(e, TAU_TL)


@njit(cache=True)
def write_margin(row: Record, s: Record, p: Record) -> None:
    """Write the columns of the stability margin. ``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS."""
    row.delta_configured = is_delta_configured(s, p)
    row.stability_margin, row.stability_margin_std = margin_with_std(s, p, row.soc_std)


@njit(cache=True)
def value_and_std(e: Record, j: int) -> tuple[float, float]:
    """Return element ``j`` of a record of EQUIVALENT and its standard deviation, both in the unit of the element."""
    return e.value[j], e.value[j] * math.sqrt(e.ln_variance[j])
