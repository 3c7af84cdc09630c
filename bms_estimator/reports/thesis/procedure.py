"""Experimental procedure of chapter 5 of the thesis on captures: steps 1 to 3, validation, SOC by interpolation.

Numbers in parentheses are equations of the thesis, and E1 to E37 are its errata (``errata``).

Step 1 fits the open-circuit voltage (2.10) to the relaxation tests. Step 2 estimates a1..a12, the coefficients of R_ts,
R_tl, C_ts and C_tl, by the adaptive observer. It uses the constant load of the smallest current, with bounds that do
not depend on captures. Step 3 computes R_s by (4.2) and fits its coefficients a13..a15. It uses the constant loads up
to 0.6C and the loads of the relaxation tests. No parameter is estimated from the capture that validates it: for the
validation of a constant load, step 3 omits that load.

The captures come from a real cell or from the simulated pack. Each result is computed on first use.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import REST_C_RATE, remove_glitches, rest_current_a
from bms_estimator.calibration.ocv.chen_mora_fit import ChenMoraFit, fit_chen_mora, pool_tests
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest, relaxation_test
from bms_estimator.calibration.ocv.table_fit import TableFit, fit_table
from bms_estimator.calibration.thesis.adapt import printed_bounds
from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun, adaptive_run
from bms_estimator.calibration.thesis.prediction import Prediction, predict, soc_by_interpolation, static_elements
from bms_estimator.calibration.thesis.series_resistance import (
    SeriesResistance,
    SeriesResistanceFit,
    fit_series_resistance,
    mean_of,
    series_resistance,
)
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.settings.observer import ObserverSettings

LOWEST_SOC = 0.05
"""SOC at which validation ends, because below it the elements and the open-circuit voltage diverge (E14)."""
KNEE_SOC = 0.1
"""SOC above which errors are given separately, because below it real cells deviate from the model under large
currents."""
STATIC_SOC = 0.5
"""SOC whose elements the static model has at every SOC."""
FULL_TOLERANCE_V = 0.004
"""Maximum distance of a first voltage at rest from the full voltage at which the capture counts as starting full, per
cell [V]."""
MAX_REST_FRACTION = 0.05
"""Maximum fraction of time at rest in a capture with a constant load."""
MAX_STEP_3_C = 0.6
"""Maximum C-rate of a constant load in step 3 [1/h]. The loads of the thesis reach 0.55C (3652 mA of 6.6 Ah); a larger
load warms the cell, which changes its resistance."""
MAX_VARIATION = 0.15
"""Maximum standard deviation of a constant current, relative to its mean."""


class Kind(Enum):
    """Kind of an experiment."""

    RELAXATION = "voltage relaxation test"
    CONSTANT = "constant load"
    STEPS = "steps"


@dataclass(frozen=True)
class Capture:
    """Capture of one experiment.

    Attributes:
        name: Name in tables and figures.
        kind: Kind of the experiment.
        samples: Raw samples, dtype ``SAMPLE``.
    """

    name: str
    kind: Kind
    samples: SampleBlock


def kind_of(name: str, samples: SampleBlock, capacity_ah: float) -> Kind:
    """Classify a capture by its current."""
    good = remove_glitches(samples, name)
    current_a = good["current_a"]
    rest_a = rest_current_a(current_a, capacity_ah)
    resting = np.abs(current_a) < rest_a
    if resting.mean() < MAX_REST_FRACTION:
        loaded = current_a[~resting]
        return Kind.CONSTANT if loaded.std() < MAX_VARIATION * abs(loaded.mean()) else Kind.STEPS
    change_a = np.r_[0.0, np.abs(np.diff(current_a))]
    loaded = current_a[~resting & (change_a < rest_a)]
    if loaded.size and loaded.std() < MAX_VARIATION * abs(loaded.mean()):
        return Kind.RELAXATION
    return Kind.STEPS


class Procedure:
    """Procedure of chapter 5 on one pack.

    Args:
        cell: Capacity, limits, and bounds of a1..a12. Without bounds, the bounds of Table 10 are used. Elements and OCV of
            the cell are not used.
        captures: Discharging captures: at least one relaxation test, and one constant load or steps.
        voltage_step_v: Resolution of the voltage [V].
    """

    def __init__(self, cell: CellModel, captures: Sequence[Capture], voltage_step_v: float) -> None:
        self.cell = cell.model_copy(update={"adaptation": printed_bounds(cell) | cell.adaptation})
        self.voltage_step_v = voltage_step_v
        self.captures = list(captures)
        for kinds in ((Kind.RELAXATION,), (Kind.CONSTANT, Kind.STEPS)):
            if not self.captures_of(*kinds):
                needed = " or ".join(kind.value for kind in kinds)
                listed = ", ".join(f"{c.name} ({c.kind.value})" for c in self.captures)
                raise UserError(f"the protocol needs a {needed}; given: {listed or 'nothing'}")

    def captures_of(self, *kinds: Kind) -> list[Capture]:
        """Return the captures of these kinds."""
        return [capture for capture in self.captures if capture.kind in kinds]

    @property
    def loads(self) -> list[Capture]:
        """Captures with which the model is compared: constant loads and steps. All but ``smallest`` validate."""
        return self.captures_of(Kind.CONSTANT, Kind.STEPS)

    @property
    def validating(self) -> list[Capture]:
        """Loads from which no parameter of the compared model was estimated."""
        return [capture for capture in self.loads if capture is not self.smallest]

    # Step 1 -----------------------------------------------------------------------------------------------------

    @cached_property
    def tests(self) -> list[RelaxationTest]:
        """Evaluated voltage relaxation tests."""
        return [
            relaxation_test(
                c.samples, self.cell.cell.capacity_ah, series_count=self.cell.cell.series_count, name=c.name
            )
            for c in self.captures_of(Kind.RELAXATION)
        ]

    @cached_property
    def single_fits(self) -> list[ChenMoraFit]:
        """Fits of (2.10) to each test, whose parameters the thesis averages by (5.1)-(5.2)."""
        return [fit_chen_mora(pool_tests([test])) for test in self.tests]

    @cached_property
    def joint_fit(self) -> ChenMoraFit:
        """Fit of (2.10) to all tests together."""
        return fit_chen_mora(pool_tests(self.tests))

    @cached_property
    def table(self) -> TableFit:
        """Monotone table through the points of all tests."""
        return fit_table(pool_tests(self.tests))

    @cached_property
    def lowest_soc(self) -> float:
        """SOC at which validation ends: ``LOWEST_SOC``, or the lowest point of all relaxation tests if that is higher.

        Below the lowest point (2.10) is extrapolated.
        """
        return max(LOWEST_SOC, min(float(test.soc.min()) for test in self.tests))

    @cached_property
    def cell_with_ocv(self) -> CellModel:
        """Cell with the open-circuit voltage of ``joint_fit``."""
        return self.cell.model_copy(update={"ocv": self.joint_fit.ocv})

    def initial_soc(self, capture: Capture) -> float:
        """Return the initial SOC: by the first voltage if the capture starts at rest below full, otherwise 1."""
        first = remove_glitches(capture.samples, capture.name)[0]
        full_v = float(self.table.ocv_v[-1])
        if capture.kind is Kind.RELAXATION or abs(first["current_a"]) > REST_C_RATE * self.cell.cell.capacity_ah:
            return 1.0
        if first["voltage_v"] > full_v - FULL_TOLERANCE_V * self.cell.cell.series_count:
            return 1.0
        grid = np.linspace(0.0, 1.0, 2001)
        return float(np.interp(first["voltage_v"], self.table(grid), grid))

    # Step 2 -----------------------------------------------------------------------------------------------------

    @cached_property
    def smallest(self) -> Capture:
        """Constant load of the smallest current, because Algorithm 1 needs a very small one.

        It is a relaxation test if there is no constant load, or if that load is the only one for validation.
        """
        constant = self.captures_of(Kind.CONSTANT) if len(self.loads) > 1 else []
        return min(constant or self.captures_of(Kind.RELAXATION), key=lambda c: float(np.mean(c.samples["current_a"])))

    @cached_property
    def adaptive(self) -> AdaptiveRun:
        """Run of the adaptive observer (Algorithm 1) on ``smallest``."""
        estimator = Estimator(
            self.cell_with_ocv,
            ObserverSettings(),
            identifier=None,
            voltage_resolution_v=self.voltage_step_v,
            initial_soc=self.initial_soc(self.smallest),
        )
        return adaptive_run(estimator, remove_glitches(self.smallest.samples, self.smallest.name))

    # Step 3 -----------------------------------------------------------------------------------------------------

    @property
    def step_3(self) -> list[Capture]:
        """Captures of step 3: relaxation tests, and constant loads up to ``MAX_STEP_3_C``."""
        max_a = MAX_STEP_3_C * self.cell.cell.capacity_ah
        constant = [c for c in self.captures_of(Kind.CONSTANT) if np.median(c.samples["current_a"]) <= max_a]
        return [*constant, *self.captures_of(Kind.RELAXATION)]

    @cached_property
    def r_s_curves(self) -> dict[str, SeriesResistance]:
        """R_s by (4.2) from each capture of ``step_3``."""
        a = self.adaptive.average
        return {c.name: series_resistance(self.cell_with_ocv, self._predict(c, a)) for c in self.step_3}

    @cached_property
    def r_s_mean(self) -> SeriesResistance:
        """Mean of ``r_s_curves`` as in Fig. 31, weighted by the square of the current (E19)."""
        return mean_of(list(self.r_s_curves.values()))

    @cached_property
    def r_s_fit(self) -> SeriesResistanceFit:
        """Fit of a13..a15 to ``r_s_mean``."""
        return fit_series_resistance(self.r_s_mean, self.lowest_soc)

    def r_s_without(self, name: str) -> SeriesResistanceFit:
        """Return the fit of a13..a15 to all captures of step 3 but ``name``."""
        if name not in self.r_s_curves:
            return self.r_s_fit
        others = [curve for load, curve in self.r_s_curves.items() if load != name]
        return fit_series_resistance(mean_of(others), self.lowest_soc)

    def a_for(self, name: str) -> Floats:
        """Return a1..a15 that validate on the load ``name``: a13..a15 are estimated without that load. Shape (16,)."""
        a = self.adaptive.average.copy()
        a[13:16] = self.r_s_without(name).a
        return a

    # Validation -------------------------------------------------------------------------------------------------

    def _predict(self, capture: Capture, a: Floats) -> Prediction:
        return predict(self.cell_with_ocv, capture.samples, self.initial_soc(capture), a=a, lowest_soc=self.lowest_soc)

    @cached_property
    def dynamic(self) -> dict[str, Prediction]:
        """Predictions of the estimated model with constant parameters for every load (section 5.3)."""
        return {c.name: self._predict(c, self.a_for(c.name)) for c in self.loads}

    @cached_property
    def static(self) -> dict[str, Prediction]:
        """Predictions of the model with its elements fixed at one SOC, for every load (chapter 6)."""
        return {c.name: self._predict(c, static_elements(self.a_for(c.name), STATIC_SOC)) for c in self.loads}

    @cached_property
    def largest_load(self) -> str:
        """Name of the constant load with the largest current (the bulb in Fig. 41); without one, of the first load."""
        constant = self.captures_of(Kind.CONSTANT) or self.loads[:1]
        return max(constant, key=lambda c: float(np.median(c.samples["current_a"]))).name

    def interpolate_soc(self, name: str) -> tuple[Floats, Floats]:
        """Return SOC and E_o by the interpolation of section 7.1 over the load ``name``."""
        cell = self.cell_with_ocv.model_copy(update={"r_s": self.r_s_without(name).element})
        return soc_by_interpolation(cell, self.dynamic[name])
