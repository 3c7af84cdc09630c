"""Voltage relaxation test: points of the open-circuit voltage from a capture of loads and rests.

The test is described in section 5.2.1 of the thesis. A cell is discharged in steps with a rest after each. At the end
of a rest its voltage is near the open-circuit voltage. The remaining relaxation is extrapolated with an exponential,
and the standard deviation of the point contains the error of the extrapolation.
"""

from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import (
    SOC_SLACK,
    mean_temperature_c,
    remove_glitches,
    resting_samples,
    soc_by_counting,
    true_runs,
    with_matched_voltages,
)
from bms_estimator.model.arrays import Floats, Masks, SampleBlock
from bms_estimator.model.errors import UserError

MIN_REST_S = 30.0
"""Minimum duration of a rest [s]. A shorter rest shows only the ohmic step."""
MAX_STD_V = 0.02
"""Maximum standard deviation of an extrapolated voltage, per cell in series [V]."""
FIT_FROM = 0.5
"""Fraction of a rest's duration after which the exponential is fitted. The fast RC pair has decayed by then."""
END_FROM = 0.98
"""Fraction of a rest's duration after which the voltages are averaged; the mean is the voltage at the rest's end."""
MIN_TAU = 0.05
"""Minimum candidate time constant, as a fraction of the rest's duration."""
MAX_TAU = 0.7
"""Maximum candidate time constant, as a fraction of the rest's duration. A slower exponential cannot be distinguished
from a drift, so that its extrapolation diverges."""
TAU_COUNT = 40
"""Number of candidate time constants."""
EXTRAPOLATION_ERROR = 0.6
"""Std of the extrapolated change, as a fraction of the change, because relaxation is no pure exponential. Half-hour
rests of a NCR18650, cut to a quarter of an hour, miss their end voltage by 2.4 mV RMS with extrapolation and by 4.7 mV
without."""
MIN_NOISE_V = 1e-4
"""Minimum noise of a voltage [V]."""
SLOW_TAU_S = 600.0
"""Time constant of a slow RC pair [s]. A shorter rest cannot distinguish it from a faster one, so that the std of its
extrapolation contains the difference between both."""
SLOW_TAU_FRACTION = 0.4
"""Std of the extrapolation of a rest shorter than ``SLOW_TAU_S``, as a fraction of the difference between the fitted
extrapolation and one with the time constant ``SLOW_TAU_S``."""
MIN_STD_V = 5e-4
"""Minimum std of a point [V]. It covers half a step of a usual converter and effects of temperature."""
NEAR_FULL = 0.995
"""SOC above which the first sample counts as full."""
NEAR_EMPTY = 0.02
"""SOC below which the last sample counts as empty."""
MIN_POINTS = 6
"""Minimum number of points, the number of parameters of (2.10) of the thesis."""


@dataclass(frozen=True)
class Rest:
    """A rest of a relaxation test.

    Attributes:
        start_s: Time of the first sample, on the capture's clock [s].
        duration_s: Duration [s].
        soc: State of charge 0..1 by coulomb counting.
        voltage_v: Voltage at the end of the rest [V].
        ocv_v: Voltage after an infinite rest, by exponential extrapolation [V].
        std_v: Standard deviation of ``ocv_v`` [V].
        temperature_c: Mean temperature [C]; NaN without a sensor.
        after_charge: True if the last load before the rest was a charge.
    """

    start_s: float
    duration_s: float
    soc: float
    voltage_v: float
    ocv_v: float
    std_v: float
    temperature_c: float
    after_charge: bool

    @property
    def remaining_v(self) -> float:
        """Extrapolated change of the voltage after the end of the rest [V]."""
        return self.ocv_v - self.voltage_v


@dataclass(frozen=True)
class RelaxationTest:
    """Open-circuit voltage from the rests of a capture.

    Attributes:
        name: Name of the capture.
        rests: Usable rests in the order of time.
        rejected: Reasons why other rests gave no point, one line each.
        glitches: Number of samples dropped as faults of the instrument.
        start_soc: SOC at the first sample.
        end_soc: SOC at the last sample.
        empty_v: Open-circuit voltage at SOC 0 [V], which is the last loaded voltage plus the overpotential at the end
            of the previous load. NaN when the capture ends above SOC 0.02 or at rest.
        full_v: Voltage of the first sample if it is at rest and full, which is the open-circuit voltage at SOC 1 [V];
            otherwise NaN.
    """

    name: str
    rests: tuple[Rest, ...]
    rejected: tuple[str, ...]
    glitches: int
    start_soc: float
    end_soc: float
    empty_v: float
    full_v: float

    @property
    def temperature_c(self) -> float:
        """Mean temperature of the rests [C]; NaN without a sensor."""
        reported_c = [rest.temperature_c for rest in self.rests if np.isfinite(rest.temperature_c)]
        return float(np.mean(reported_c)) if reported_c else float("nan")

    @property
    def soc(self) -> Floats:
        """SOC of the points, 0..1."""
        return np.array([rest.soc for rest in self.rests])

    @property
    def ocv_v(self) -> Floats:
        """Open-circuit voltage of the points [V]."""
        return np.array([rest.ocv_v for rest in self.rests])

    @property
    def std_v(self) -> Floats:
        """Standard deviation of the points [V]."""
        return np.array([rest.std_v for rest in self.rests])


def relaxation_test(
    samples: SampleBlock,
    capacity_ah: float,
    *,
    name: str,
    initial_soc: float = 1.0,
    series_count: int = 1,
) -> RelaxationTest:
    """Extract points of the open-circuit voltage from a capture of loads and rests.

    Args:
        samples: Raw samples, dtype ``SAMPLE``. This function removes glitches.
        capacity_ah: Capacity that SOC is counted against [Ah].
        name: Name of the capture for messages.
        initial_soc: SOC at the first sample, 0..1.
        series_count: Cells in series, for limits that are given per cell.

    Raises:
        UserError: The capture has no or only short rests, charges more than it discharges, or contradicts the sign of
            the current or the capacity.
    """
    good = remove_glitches(samples, name)
    soc = soc_by_counting(good, capacity_ah, initial_soc)
    resting = resting_samples(good, capacity_ah)
    _check_charge(name, good, soc, resting, capacity_ah)
    rests, rejected = find_rests(good, soc, resting, series_count)
    _check_rests(name, good, rests, rejected, resting)
    return RelaxationTest(
        name=name,
        rests=tuple(rests),
        rejected=tuple(rejected),
        glitches=samples.size - good.size,
        start_soc=initial_soc,
        end_soc=float(soc[-1]),
        empty_v=_empty_v(good, soc, resting, rests),
        full_v=float(good["voltage_v"][0]) if resting[0] and initial_soc > NEAR_FULL else float("nan"),
    )


def find_rests(good: SampleBlock, soc: Floats, resting: Masks, series_count: int) -> tuple[list[Rest], list[str]]:
    """Return the usable rests of a capture, and a reason for each rejected rest.

    Args:
        good: Dtype ``SAMPLE``, without glitches.
        soc: SOC at each sample.
        resting: True for each sample at rest.
        series_count: Cells in series, for limits that are given per cell.
    """
    good = with_matched_voltages(good)
    rests: list[Rest] = []
    rejected: list[str] = []
    for first, last in true_runs(resting):
        duration_s = float(good["time_s"][last - 1] - good["time_s"][first])
        if duration_s < MIN_REST_S:
            rejected.append(
                f"rest at {good['time_s'][first]:.0f} s: {duration_s:.0f} s long, shorter than {MIN_REST_S:.0f} s"
            )
            continue
        charged = first > 0 and bool(good["current_a"][first - 1] < 0.0)
        rest = _extrapolated_rest(good[first:last], float(soc[last - 1]), after_charge=charged)
        if rest.std_v > MAX_STD_V * series_count:
            rejected.append(
                f"rest at {rest.start_s:.0f} s: {duration_s:.0f} s is too short, its end voltage {rest.voltage_v:.4f} V "
                f"extrapolates to {rest.ocv_v:.4f} +- {rest.std_v:.4f} V"
            )
            continue
        rests.append(rest)
    return rests, rejected


def _empty_v(good: SampleBlock, soc: Floats, resting: Masks, rests: list[Rest]) -> float:
    """Return the open-circuit voltage at the end of a capture that ends empty and under load [V], otherwise NaN."""
    if resting[-1] or abs(soc[-1]) > NEAR_EMPTY or not rests:
        return float("nan")
    first = int(np.searchsorted(good["time_s"], rests[-1].start_s))
    overpotential_v = rests[-1].ocv_v - float(good["voltage_v"][first - 1])
    return min(float(good["voltage_v"][-1]) + overpotential_v, rests[-1].ocv_v)


def _check_charge(name: str, good: SampleBlock, soc: Floats, resting: Masks, capacity_ah: float) -> None:
    """Check the sign of the current and the capacity.

    Raises:
        UserError: More charge goes in than out, or SOC leaves 0..1.
    """
    change = np.where(resting[:-1], 0.0, np.diff(soc))  # noise at rest has both signs
    discharged = np.maximum(-change, 0.0).sum()
    charged = np.maximum(change, 0.0).sum()
    if charged > discharged:
        raise UserError(
            f"{name}: current has the wrong sign or the capture charges: {discharged * capacity_ah:.3f} Ah out, "
            f"{charged * capacity_ah:.3f} Ah in while the voltage went from {good['voltage_v'][0]:.3f} to "
            f"{good['voltage_v'][-1]:.3f} V; discharge must be positive (--current-sign)"
        )
    low, high = float(soc.min()), float(soc.max())
    if low < -SOC_SLACK or high > 1.0 + SOC_SLACK:
        raise UserError(
            f"{name}: SOC runs from {soc[0]:.3f} to {low:.3f}, outside 0..1: {discharged * capacity_ah:.3f} Ah were drawn, "
            f"more than a capacity of {capacity_ah:g} Ah holds; give the right capacity or initial SOC"
        )


def initial_rest_v(samples: SampleBlock, name: str, capacity_ah: float) -> float:
    """Return the voltage at the end of the rest that a capture starts with [V]; NaN when it starts under load.

    Raises:
        UserError: No good samples, see ``remove_glitches``.
    """
    good = remove_glitches(samples, name)
    resting = resting_samples(good, capacity_ah)
    first, last = next(iter(true_runs(resting)), (1, 1))
    return float(good["voltage_v"][last - 1]) if first == 0 else float("nan")


def _extrapolated_rest(rest: SampleBlock, soc: float, *, after_charge: bool) -> Rest:
    """Extrapolate a rest to infinite time by an exponential fitted to the second half of the rest."""
    time_s = rest["time_s"] - rest["time_s"][0]
    duration_s = float(time_s[-1])
    late = time_s >= FIT_FROM * duration_s
    ocv_v, spread_v = _extrapolate(time_s[late], rest["voltage_v"][late], duration_s)
    voltage_v = float(rest["voltage_v"][time_s >= END_FROM * duration_s].mean())
    # a short rest cannot exclude the slow time constant
    slow_coefficients, _, _ = _fit_with_tau(time_s[late], rest["voltage_v"][late], SLOW_TAU_S)
    slow_std_v = SLOW_TAU_FRACTION * (float(slow_coefficients[0]) - ocv_v) if duration_s < SLOW_TAU_S else 0.0
    return Rest(
        start_s=float(rest["time_s"][0]),
        duration_s=duration_s,
        soc=soc,
        voltage_v=voltage_v,
        ocv_v=ocv_v,
        std_v=float(
            np.sqrt(spread_v**2 + slow_std_v**2 + (EXTRAPOLATION_ERROR * (ocv_v - voltage_v)) ** 2 + MIN_STD_V**2)
        ),
        temperature_c=mean_temperature_c(rest),
        after_charge=after_charge,
    )


def _extrapolate(time_s: Floats, voltage_v: Floats, duration_s: float) -> tuple[float, float]:
    """Fit v = v_inf + b e^(-t/tau); return v_inf and its standard deviation [V].

    For each tau of a grid, v_inf and b are fitted by linear least squares. The result is the mean over the grid,
    weighted by likelihood, so that the standard deviation contains the uncertainty of tau.
    """
    elapsed = time_s - time_s[0]
    taus = np.geomspace(MIN_TAU * duration_s, MAX_TAU * duration_s, TAU_COUNT)
    fits = [_fit_with_tau(elapsed, voltage_v, tau) for tau in taus]
    v_inf = np.array([coefficients[0] for coefficients, _, _ in fits])
    residual2 = np.array([s for _, _, s in fits])
    variance = max(float(residual2.min()) / max(elapsed.size - 3, 1), MIN_NOISE_V**2)
    likelihood = np.exp(-0.5 * (residual2 - residual2.min()) / variance)
    likelihood /= likelihood.sum()
    variance_of_fits = variance * np.array([np.linalg.pinv(basis.T @ basis)[0, 0] for _, basis, _ in fits])
    mean_v = float(likelihood @ v_inf)
    spread_v = float(np.sqrt(likelihood @ (variance_of_fits + (v_inf - mean_v) ** 2)))
    return mean_v, spread_v


def _fit_with_tau(elapsed: Floats, voltage_v: Floats, tau_s: float) -> tuple[Floats, Floats, float]:
    """Fit the exponential with time constant ``tau_s``; return coefficients, basis and squared residual."""
    basis = np.column_stack([np.ones_like(elapsed), np.exp(-elapsed / tau_s)])
    coefficients = np.linalg.lstsq(basis, voltage_v, rcond=None)[0]
    residual = voltage_v - basis @ coefficients
    return coefficients, basis, float(residual @ residual)


def _check_rests(name: str, good: SampleBlock, rests: list[Rest], rejected: list[str], resting: Masks) -> None:
    """Check that a capture has enough usable rests.

    Raises:
        UserError: No rests, or fewer usable ones than ``MIN_POINTS``.
    """
    hours = (good["time_s"][-1] - good["time_s"][0]) / 3600.0
    if not resting.any():
        min_a = float(np.abs(good["current_a"]).min())
        raise UserError(
            f"{name}: no rests in {hours:.2f} h: the current never falls below {min_a:.3f} A; "
            "a relaxation test discharges in steps with a rest after each"
        )
    if len(rests) < MIN_POINTS:
        reasons = "".join(f"\n  {line}" for line in rejected[:8])
        raise UserError(
            f"{name}: {len(rests)} usable rests, at least {MIN_POINTS} are needed; {len(rejected)} others were "
            f"too short or too far from relaxed{':' if reasons else ''}{reasons}"
        )
