"""The experimental protocol of chapter 5 on captures: steps 1 to 3, validation, SOC by interpolation.

The captures are real ones, or those of the simulated pack. Each result is computed on first use.

No parameter is estimated from the capture that validates it. Step 1 takes the relaxation tests alone; step 2 the
constant
load of the smallest current, with bounds that no capture has a part in; step 3 the constant loads up to
0.6C and the loads of the relaxation tests, but for a constant load's own validation all others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from bms_estimator.calibration.cleaning.rests import remove_glitches, rest_current_a
from bms_estimator.calibration.ocv.chen_mora_fit import ChenMoraFit, fit_chen_mora
from bms_estimator.calibration.ocv.points import pooled
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest, relaxation_test
from bms_estimator.calibration.ocv.table_fit import TableFit, fit_table
from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun, adaptive_run
from bms_estimator.calibration.thesis.prediction import Prediction, predict, soc_by_interpolation, static_elements
from bms_estimator.calibration.thesis.printed_bounds import printed_bounds
from bms_estimator.calibration.thesis.series_resistance import (
    SeriesResistance,
    SeriesResistanceFit,
    fit_series_resistance,
    mean_of,
    series_resistance,
)
from bms_estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import ObserverSettings

LOWEST_SOC = 0.05
"""Validation ends here: below, the elements and the open-circuit voltage run off (E14)."""
KNEE_SOC = 0.1
"""Errors are given above it as well: below it real cells leave the form of the elements under any large current."""
STATIC_SOC = 0.5
"""SOC at which the static model is frozen."""
REST_SHARE = 0.05
"""A capture that rests for a larger share of its time is one of steps."""
LARGEST_C = 0.6
"""A constant load of a larger C-rate validates only: the thesis's go to 0.55C (3652 mA of 6.6 Ah), and what a cell shows
under more is the resistance of a cell that the load has warmed [1/h]."""
STEADY = 0.15
"""A current that varies by less than this of its mean is constant."""


class Kind(Enum):
    """Purpose of a capture."""

    RELAXATION = "voltage relaxation test"
    CONSTANT = "constant load"
    STEPS = "steps"


@dataclass(frozen=True)
class Capture:
    """One experiment.

    Attributes:
        name: What to call it.
        kind: Purpose of the capture.
        samples: Dtype ``SAMPLE``, raw.
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
    if resting.mean() < REST_SHARE:
        loaded = current_a[~resting]
        return Kind.CONSTANT if loaded.std() < STEADY * abs(loaded.mean()) else Kind.STEPS
    loaded = current_a[~resting & (np.r_[0.0, np.abs(np.diff(current_a))] < rest_a)]
    if loaded.size and loaded.std() < STEADY * abs(loaded.mean()):
        return Kind.RELAXATION
    return Kind.STEPS


class Procedure:
    """Chapter 5 on one pack.

    Args:
        cell: Supplies capacity, limits, and the bounds of (3.18) if it has any, otherwise those of Table 10; its elements and OCV are not used.
        captures: At least one relaxation test, and one constant load or steps; discharging.
        voltage_step_v: One step of the voltage converter [V].
    """

    def __init__(self, cell: CellModel, captures: Sequence[Capture], voltage_step_v: float) -> None:
        self.cell = cell.model_copy(update={"adaptation": printed_bounds(cell) | cell.adaptation})
        self.voltage_step_v = voltage_step_v
        self.captures = list(captures)
        for kinds in ((Kind.RELAXATION,), (Kind.CONSTANT, Kind.STEPS)):
            if not self.of(*kinds):
                needed = " or ".join(kind.value for kind in kinds)
                listed = ", ".join(f"{c.name} ({c.kind.value})" for c in self.captures)
                raise UserError(f"the protocol needs a {needed}; given: {listed or 'nothing'}")

    def of(self, *kinds: Kind) -> list[Capture]:
        """Return the captures of given kinds."""
        return [capture for capture in self.captures if capture.kind in kinds]

    @property
    def loads(self) -> list[Capture]:
        """Captures that the model is compared on: constant loads and steps. All but ``smallest`` validate."""
        return self.of(Kind.CONSTANT, Kind.STEPS)

    @property
    def validating(self) -> list[Capture]:
        """Loads that gave the model they are compared with no parameter."""
        return [capture for capture in self.loads if capture is not self.smallest]

    # Step 1 -----------------------------------------------------------------------------------------------------

    @cached_property
    def tests(self) -> list[RelaxationTest]:
        """The voltage relaxation tests."""
        return [
            relaxation_test(
                c.samples, self.cell.cell.capacity_ah, series_count=self.cell.cell.series_count, name=c.name
            )
            for c in self.of(Kind.RELAXATION)
        ]

    @cached_property
    def single_fits(self) -> list[ChenMoraFit]:
        """(2.10) fitted to each test, for (5.1)-(5.2)."""
        return [fit_chen_mora(pooled([test])) for test in self.tests]

    @cached_property
    def joint_fit(self) -> ChenMoraFit:
        """(2.10) fitted to all tests together."""
        return fit_chen_mora(pooled(self.tests))

    @cached_property
    def table(self) -> TableFit:
        """The monotone table through the points of all tests."""
        return fit_table(pooled(self.tests))

    @cached_property
    def lowest_soc(self) -> float:
        """Return the SOC at which validation ends: ``LOWEST_SOC``, or above it the last point of step 1 of all tests.

        Below that (2.10) is a guess.
        """
        return max(LOWEST_SOC, min(float(test.soc.min()) for test in self.tests))

    @cached_property
    def with_ocv(self) -> CellModel:
        """The cell with the fitted (2.10)."""
        return self.cell.model_copy(update={"ocv": self.joint_fit.ocv})

    def initial_soc(self, capture: Capture) -> float:
        """1 if the capture starts as full as the relaxation tests do, otherwise from its first voltage at rest."""
        first = remove_glitches(capture.samples, capture.name)[0]
        full_v = float(self.table.ocv_v[-1])
        if capture.kind is Kind.RELAXATION or abs(first["current_a"]) > 0.01 * self.cell.cell.capacity_ah:
            return 1.0
        if first["voltage_v"] > full_v - 0.004 * self.cell.cell.series_count:
            return 1.0
        grid = np.linspace(0.0, 1.0, 2001)
        return float(np.interp(first["voltage_v"], self.table(grid), grid))

    # Step 2 -----------------------------------------------------------------------------------------------------

    @cached_property
    def smallest(self) -> Capture:
        """Constant load of the smallest current, because Algorithm 1 needs a very small one.

        A relaxation test, if that load is the only one to validate with, or missing.
        """
        spare = len(self.loads) > 1 and self.of(Kind.CONSTANT)
        return min(spare or self.of(Kind.RELAXATION), key=lambda c: float(np.mean(c.samples["current_a"])))

    @cached_property
    def adaptive(self) -> AdaptiveRun:
        """Algorithm 1 on it."""
        estimator = Estimator(
            self.with_ocv,
            ObserverSettings(),
            identifier=None,
            voltage_resolution_v=self.voltage_step_v,
            initial_soc=self.initial_soc(self.smallest),
        )
        return adaptive_run(estimator, remove_glitches(self.smallest.samples, self.smallest.name))

    # Step 3 -----------------------------------------------------------------------------------------------------

    @property
    def step_3(self) -> list[Capture]:
        """Each relaxation test, and each constant load up to ``LARGEST_C``."""
        largest_a = LARGEST_C * self.cell.cell.capacity_ah
        constant = [c for c in self.of(Kind.CONSTANT) if np.median(c.samples["current_a"]) <= largest_a]
        return [*constant, *self.of(Kind.RELAXATION)]

    @cached_property
    def r_s_curves(self) -> dict[str, SeriesResistance]:
        """R_s by (4.2) for each of these."""
        a = self.adaptive.average
        return {c.name: series_resistance(self.with_ocv, self._predict(c, a)) for c in self.step_3}

    @cached_property
    def r_s_mean(self) -> SeriesResistance:
        """Their mean, as in Fig. 31, each weighted by its current squared (E19)."""
        return mean_of(list(self.r_s_curves.values()))

    @cached_property
    def r_s_fit(self) -> SeriesResistanceFit:
        """a13..a15."""
        return fit_series_resistance(self.r_s_mean, self.lowest_soc)

    def r_s_without(self, name: str) -> SeriesResistanceFit:
        """Return the R_s of all captures but ``name``."""
        if name not in self.r_s_curves:
            return self.r_s_fit
        others = [curve for load, curve in self.r_s_curves.items() if load != name]
        return fit_series_resistance(mean_of(others), self.lowest_soc)

    def a_for(self, name: str) -> Floats:
        """a1..a15 for the load ``name``, with nothing of it in a13..a15. Shape (16,)."""
        a = self.adaptive.average.copy()
        a[13:16] = self.r_s_without(name).a
        return a

    # Validation -------------------------------------------------------------------------------------------------

    def _predict(self, capture: Capture, a: Floats) -> Prediction:
        return predict(self.with_ocv, capture.samples, self.initial_soc(capture), a=a, lowest_soc=self.lowest_soc)

    @cached_property
    def dynamic(self) -> dict[str, Prediction]:
        """The estimated model, frozen, on every load (5.3)."""
        return {c.name: self._predict(c, self.a_for(c.name)) for c in self.loads}

    @cached_property
    def static(self) -> dict[str, Prediction]:
        """Run the model with its elements fixed at one SOC (chapter 6)."""
        return {c.name: self._predict(c, static_elements(self.a_for(c.name), STATIC_SOC)) for c in self.loads}

    @cached_property
    def largest(self) -> str:
        """Name of the constant load of the largest current, the bulb of Fig. 41; without one, of the first load."""
        constant = self.of(Kind.CONSTANT) or self.loads[:1]
        return max(constant, key=lambda c: float(np.median(c.samples["current_a"]))).name

    def interpolated(self, name: str) -> tuple[Floats, Floats]:
        """SOC and E_o by 7.1 over the run of the load ``name``."""
        cell = self.with_ocv.model_copy(update={"r_s": self.r_s_without(name).element})
        return soc_by_interpolation(cell, self.dynamic[name])
