"""Simulations of the thesis with the cell of Chen and Mora.

Numbers in parentheses are equations and sections of the thesis, and E1 to E37 are its errata (``errata``).

The thesis simulates schemes 1 to 3 (3.2.5) and the improved method (4.1.1). They differ in the law that adapts the
coefficients a1..a15 of the elements: (3.16) in scheme 1, (3.17) in scheme 2, and (3.18) in scheme 3 and in the improved
method. The observer's gain is N(k), (3.10).

The thesis does not print all values. Those chosen here are N(k) = E_2.5(-k^2.5), the initial values k0 = 0 and
x2(0) = x3(0) = 0, and no sensor noise. If the printed weights contradict the printed estimates, the inferred weights
are used (E4, E24, E32).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun, adaptive_run
from bms_estimator.calibration.thesis.prediction import Prediction, predict, static_elements
from bms_estimator.calibration.thesis.series_resistance import (
    SeriesResistance,
    SeriesResistanceFit,
    fit_series_resistance,
    mean_of,
    series_resistance,
)
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, r_s, r_tl, r_ts, simulate_cell
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import Bounds
from bms_estimator.reports.thesis import printed_values
from bms_estimator.settings.observer import ObserverSettings

STEP_S = 0.01
"""Sample interval of the thesis, 100 Hz [s]."""
CURRENT_A = 0.275
"""Current of 1C of the 275 mAh cell (E12) [A]."""
SMALL_CURRENT_A = 0.0275
"""Current of C/10 for step 2 [A]. Algorithm 1 needs a very small current, which the thesis does not print."""
R_S_CURRENTS_A = (0.1, 0.275, 0.55)
"""Currents for (4.2) [A]. The thesis does not print its currents."""
LOWEST_SOC = 0.05
"""Lower end of the SOC range of errors, because below it the elements diverge (E14)."""
SOC_GRID = np.linspace(LOWEST_SOC, 1.0, 951)
"""SOC grid over which errors are computed."""
PULSE_S = 600.0
"""Half period of the pulsed load of Fig. 39 [s]."""
STATIC_SOC = 0.5
"""SOC whose elements the static model has. The thesis does not print this SOC."""
FINAL_SOC = 0.02
"""SOC at which the comparison of model and cell ends. Below delta2 = 0.0179 the C_tl of Table 5's estimates is
negative."""
IDEAL_RESOLUTION_V = 1e-6
"""Voltage resolution of simulations without a sensor [V], which is negligible."""
EPSILON_V = 1e-3
"""eps2 of Algorithm 1 in simulation, the maximum error of a converged observer [V]."""
LARGE_START_T_INT_S = 60.0
"""Start t_int of the average (3.19) for a start with a large error, which settles late [s]."""
START_TIMES_S = np.r_[np.arange(0.0, 10.0, 0.0002), np.arange(10.0, LARGE_START_T_INT_S, STEP_S)]
"""Sample times of a start with a large error [s]. In the kernel N is constant during a step, although N decreases while
k grows. With steps of 0.2 ms the result agrees with the differential equations to four digits; with 10 ms the fitted
lambda is 2 % larger."""
AFTER_START_S = 1.0
"""Sample interval after ``START_TIMES_S`` [s]."""
ALPHA = 2.5
"""Default exponent alpha of the gain N(k), (3.10)."""
OTHER_ALPHA = 2.9
"""Another alpha with which Tables 2 and 3 can be fitted."""
HIGH_CURRENT_A = 4.0 * CURRENT_A
"""Current of 4C, far above the currents of the thesis's simulations [A]."""


@dataclass(frozen=True)
class FittedStart:
    """Runs of schemes 1 and 2 from an initial state that is fitted to both printed tables, 2 and 3.

    Attributes:
        start_v: Initial x2 + x3, the sum of the voltages of the RC pairs, with x2 = x3 [V].
        start_error_v: Initial error e [V].
        lambda_: lambda of (3.10).
        alpha: Exponent alpha of (3.10), chosen and not fitted.
        scheme_1: Run of scheme 1.
        scheme_2: Run of scheme 2.
    """

    start_v: float
    start_error_v: float
    lambda_: float
    alpha: float
    scheme_1: AdaptiveRun
    scheme_2: AdaptiveRun


def to_samples(time_s: Floats, current_a: Floats, voltage_v: Floats) -> SampleBlock:
    """Return arrays as samples."""
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["voltage_v"] = time_s, current_a, voltage_v
    samples["temperature_c"] = np.nan
    return samples


def discharge(cell: CellModel, current_a: float, step_s: float, first_s: Floats | None = None) -> SampleBlock:
    """Simulate a full cell under constant current down to SOC 0.005.

    Args:
        cell: Cell to simulate.
        current_a: Current, positive on discharge [A].
        step_s: Sample interval [s].
        first_s: Times of the first samples, after which ``step_s`` applies [s].
    """
    seconds = 0.995 * cell.cell.capacity_ah * 3600.0 / current_a
    time_s = np.arange(0.0, seconds, step_s, dtype=np.float64)
    if first_s is not None:
        time_s = np.r_[first_s, time_s[time_s > first_s[-1]]]
    currents = np.full(time_s.size, current_a)
    voltage_v, _ = simulate_cell((1.0, 0.0, 0.0), time_s, currents, cell.cell.capacity_ah * 3600.0, cell.a)
    return to_samples(time_s, currents, voltage_v)


def observer_settings(law: str, lambda_: float = 1.0, alpha: float = ALPHA) -> ObserverSettings:
    """Return the settings of the thesis: no dead zone and no reset of k. The sign of N follows erratum 1."""
    printed_law = {"law": law, "dead_zone_v": 0.0, "rearm_gain": None, "epsilon_v": EPSILON_V}
    return ObserverSettings.model_validate(printed_law | {"lambda": lambda_, "alpha": alpha})


def with_bounds(cell: CellModel, bounds: dict[int, Bounds]) -> CellModel:
    """Return the cell with other bounds of a1..a12."""
    return cell.model_copy(update={"adaptation": {f"a{i}": b for i, b in bounds.items()}})


def table_5_cell() -> CellModel:
    """Return the cell of Chen and Mora with the bounds and weights of Table 5."""
    return with_bounds(load_cell("chen_mora"), {i: printed_values.bounds("5", i) for i in printed_values.BOUNDS})


class Simulation:
    """Runs of the simulations of chapters 3 and 4, each computed on first use."""

    def __init__(self) -> None:
        self.cell = table_5_cell()

    @cached_property
    def truth(self) -> SampleBlock:
        """Samples of the cell of Chen and Mora at 0.275 A and 100 Hz."""
        return discharge(self.cell, CURRENT_A, STEP_S)

    def _scheme(self, law: str) -> AdaptiveRun:
        """Run a scheme from the rounded a1..a15 of Tables 2 and 3, with x2(0) = x3(0) = 0."""
        return adaptive_run(self._observer(law), self.truth)

    def _observer(self, law: str, lambda_: float = 1.0, alpha: float = ALPHA) -> Estimator:
        """Return an observer whose parameters start and converge as in Tables 2 to 4."""
        settings = observer_settings(law, lambda_, alpha)
        estimator = Estimator(
            self.cell, settings, identifier=None, voltage_resolution_v=IDEAL_RESOLUTION_V, initial_soc=1.0
        )
        record = estimator.settings[0]
        record["a_initial"][1:] = printed_values.CHEN_MORA_ROUNDED
        record["target"][1:] = printed_values.CHEN_MORA_ROUNDED
        if law == "scheme-2":
            record["rate"][1:] = [100.0 if i in printed_values.SMALL else 0.0 for i in range(1, 16)]
        if law == "scheme-3":
            record["rate"][1:] = 0.0
            for i, (upper, lower, *_) in printed_values.TABLE_4.items():
                upper_weight, lower_weight = printed_values.TABLE_4_WEIGHTS
                record["rate"][i] = upper_weight + lower_weight
                record["target"][i] = (upper_weight * upper + lower_weight * lower) / (upper_weight + lower_weight)
        return estimator

    @cached_property
    def started_truth(self) -> SampleBlock:
        """Samples of the cell at 0.275 A, with a shorter interval in the first minute."""
        return discharge(self.cell, CURRENT_A, AFTER_START_S, START_TIMES_S)

    def _run_from_start(self, law: str, start_v: float, lambda_: float, alpha: float) -> AdaptiveRun:
        """Run a scheme from x2 = x3 = start_v / 2."""
        estimator = self._observer(law, lambda_, alpha)
        estimator.run(self.started_truth[:1])
        estimator.state["v_ts"][0] = estimator.state["v_tl"][0] = 0.5 * start_v
        return adaptive_run(estimator, self.started_truth[1:], t_int_s=LARGE_START_T_INT_S)

    @cached_property
    def scheme_1(self) -> AdaptiveRun:
        """Run of scheme 1 from the rounded values of Table 2."""
        return self._scheme("scheme-1")

    @cached_property
    def scheme_2(self) -> AdaptiveRun:
        """Run of scheme 2 from the rounded values of Table 3."""
        return self._scheme("scheme-2")

    @cached_property
    def scheme_3(self) -> AdaptiveRun:
        """Run of scheme 3: (3.18) for a1, a3, a6, a13, a15 with the bounds of Table 4, and (3.16) for the others."""
        return self._scheme("scheme-3")

    @cached_property
    def fitted_start(self) -> FittedStart:
        """Schemes 1 and 2 with the start and lambda for which a2 changes as printed in Tables 2 and 3."""
        return self._fit_start(ALPHA, near_v=1.4, near_lambda=9.0)

    @cached_property
    def other_starts(self) -> tuple[FittedStart, FittedStart]:
        """Two other solutions for the start: one with the opposite sign, one with another alpha."""
        return (
            self._fit_start(ALPHA, near_v=-1.4, near_lambda=9.0),
            self._fit_start(OTHER_ALPHA, near_v=1.4, near_lambda=17.0),
        )

    def _fit_start(self, alpha: float, near_v: float, near_lambda: float) -> FittedStart:
        """Fit start voltage and lambda to the changes of a2 in Tables 2 and 3, near ``near_v`` and ``near_lambda``."""
        shifts = {"scheme-1": printed_values.TABLE_2_SHIFT, "scheme-2": printed_values.TABLE_3_SHIFT}

        def residuals(start_v_and_lambda: Floats) -> list[float]:
            runs = (self._run_from_start(law, start_v_and_lambda[0], start_v_and_lambda[1], alpha) for law in shifts)
            return [
                float(run.average[2] - printed_values.CHEN_MORA_ROUNDED[1]) / shift - 1.0
                for run, shift in zip(runs, shifts.values(), strict=True)
            ]

        start_v, lambda_ = least_squares(residuals, (near_v, near_lambda), xtol=1e-3).x
        runs = [self._run_from_start(law, start_v, lambda_, alpha) for law in shifts]
        ohmic_v = CURRENT_A * r_s(1.0, self.cell.a)
        r_s_of_observer = r_s(1.0, np.r_[0.0, printed_values.CHEN_MORA_ROUNDED])
        # the error (3.15) of the output (3.14), which contains u R_s with u = -N e and N(0) = 1
        error_v = (start_v - ohmic_v) / (1.0 + r_s_of_observer)
        return FittedStart(float(start_v), float(error_v), float(lambda_), alpha, runs[0], runs[1])

    def frozen(self, a: Floats, lowest_soc: float = 0.01) -> Prediction:
        """Predict with constant parameters ``a`` the voltage of every tenth sample of ``truth``."""
        return predict(self.cell, self.truth[::10], 1.0, a=a, lowest_soc=lowest_soc)

    @cached_property
    def improved(self) -> AdaptiveRun:
        """Run of the improved method with the settings of Table 5 (a7, a8: E4, E24) at C/10."""
        samples = discharge(self.cell, SMALL_CURRENT_A, 10.0 * STEP_S)
        estimator = Estimator(
            self.cell,
            observer_settings("improved"),
            identifier=None,
            voltage_resolution_v=IDEAL_RESOLUTION_V,
            initial_soc=1.0,
        )
        return adaptive_run(estimator, samples)

    @cached_property
    def improved_a(self) -> Floats:
        """a1..a12 of step 2 with a13..a15 of step 3, shape (16,)."""
        a = self.improved.average.copy()
        a[13:16] = self.r_s_fit.a
        return a

    @cached_property
    def printed_a(self) -> Floats:
        """Printed a1..a15 of Tables 5 and 6, shape (16,)."""
        return printed_values.tables_5_and_6()

    @cached_property
    def r_s_curves(self) -> dict[float, SeriesResistance]:
        """R_s by (4.2) for each current, with the estimated a1..a12."""
        return {i: self._r_s(i, self.improved.average) for i in R_S_CURRENTS_A}

    def _r_s(self, current_a: float, a: Floats) -> SeriesResistance:
        samples = discharge(self.cell, current_a, 1.0)
        return series_resistance(self.cell, predict(self.cell, samples, 1.0, a=a, lowest_soc=0.02))

    @cached_property
    def r_s_mean(self) -> SeriesResistance:
        """Mean of ``r_s_curves``, as in Fig. 22."""
        return mean_of(list(self.r_s_curves.values()))

    @cached_property
    def r_s_fit(self) -> SeriesResistanceFit:
        """Fit of a13..a15 to ``r_s_mean``."""
        return fit_series_resistance(self.r_s_mean, LOWEST_SOC)

    @cached_property
    def pulsed(self) -> SampleBlock:
        """Samples of the true cell under a pulsed 1C load, from full to empty."""
        time_s = np.arange(0.0, 2.0 * 0.97 * 3600.0, 1.0, dtype=np.float64)
        current_a = np.where(time_s % (2.0 * PULSE_S) < PULSE_S, CURRENT_A, 0.0)
        capacity_as = self.cell.cell.capacity_ah * 3600.0
        voltage_v, _ = simulate_cell((1.0, 0.0, 0.0), time_s, current_a, capacity_as, self.cell.a)
        return to_samples(time_s, current_a, voltage_v)

    def dynamic(self, a: Floats, lowest_soc: float = FINAL_SOC) -> Prediction:
        """Predict with constant parameters ``a`` the voltage of the pulsed load."""
        return predict(self.cell, self.pulsed, 1.0, a=a, lowest_soc=lowest_soc)

    def constant_error_percent(self, current_a: float) -> float:
        """Return the mean error of the printed Tables 5 and 6 at a constant current, down to ``FINAL_SOC`` [%]."""
        samples = discharge(self.cell, current_a, 1.0)
        return predict(self.cell, samples, 1.0, a=self.printed_a, lowest_soc=FINAL_SOC).mean_percent

    def printed_r_s_plateau(self, current_a: float) -> float:
        """Return a15 of (4.2) with the printed Table 5 [ohm]: R_s at SOC 0.5, where the term of a13 vanishes."""
        curve = self._r_s(current_a, self.printed_a)
        return float(np.interp(0.5, curve.soc, curve.r_s_ohm))

    def static(self, a: Floats, lowest_soc: float = FINAL_SOC) -> Prediction:
        """Predict the voltage of the pulsed load with the elements that ``a`` gives at ``STATIC_SOC``."""
        return self.dynamic(static_elements(a, STATIC_SOC), lowest_soc)


ELEMENTS = {"R_ts": r_ts, "C_ts": c_ts, "R_tl": r_tl, "C_tl": c_tl}
"""Function of SOC and parameters by the name of the element."""


def element(name: str, a: Floats, soc: Floats = SOC_GRID) -> Floats:
    """Return an element, or a product such as "R_ts C_ts", over SOC."""
    values = np.ones(soc.size)
    for part in name.split():
        values *= np.array([ELEMENTS[part](x, a) for x in soc])
    return values


def mean_error_percent(name: str, a: Floats, true: Floats) -> float:
    """Return the mean error of an element over ``SOC_GRID`` relative to the true value [%] (E7)."""
    true_values = element(name, true)
    return float(np.mean(np.abs(element(name, a) - true_values) / np.abs(true_values)) * 100.0)
