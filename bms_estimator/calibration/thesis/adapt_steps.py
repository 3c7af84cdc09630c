"""Steps 2 and 3 of the thesis on captures.

Step 2 runs the adaptive observer (Algorithm 1) and averages its parameters by (3.19), which gives a1..a12, the
coefficients of R_ts, R_tl, C_ts and C_tl. Step 3 computes R_s by (4.2) and fits its coefficients a13..a15. Step 1, the
fit of the open-circuit voltage to rests, is the command `ocv`. Its result is part of the given cell.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun, adaptive_run
from bms_estimator.calibration.thesis.prediction import predict
from bms_estimator.calibration.thesis.series_resistance import (
    SeriesResistanceFit,
    fit_series_resistance,
    mean_of,
    series_resistance,
)
from bms_estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import ObserverSettings

VOLTAGE_STEP_V = 1e-3
"""Assumed resolution of a capture's voltage [V]."""


@dataclass(frozen=True)
class CaptureWithSoc:
    """Samples of a capture without glitches, and its initial SOC.

    Attributes:
        samples: Dtype ``SAMPLE``.
        soc: SOC at the first sample, 0..1.
    """

    samples: SampleBlock
    soc: float


@dataclass(frozen=True)
class AdaptedElements:
    """Result of steps 2 and 3.

    Attributes:
        run: Step 2, Algorithm 1 over one capture with the averages (3.19).
        r_s: Step 3, a13..a15 fitted to (4.2) over all captures.
    """

    run: AdaptiveRun
    r_s: SeriesResistanceFit

    @property
    def a(self) -> Floats:
        """a1..a15 at index 1..15. Shape (16,)."""
        a = self.run.average.copy()
        a[13:16] = self.r_s.a
        return a


def steps_2_and_3(cell: CellModel, captures: Sequence[CaptureWithSoc], lowest_soc: float) -> AdaptedElements:
    """Adapt a1..a12 to the capture with the smallest mean current, then fit a13..a15 to all captures.

    Algorithm 1 needs a very small current; (4.2) needs several currents.

    Args:
        cell: Capacity, open-circuit voltage, and the bounds of (3.18).
        captures: Captures that start from rest.
        lowest_soc: SOC below which (4.2) is not evaluated, because the open-circuit voltage is uncertain there.

    Raises:
        UserError: No good sample, no current, or too small a range of SOC for a13..a15.
    """
    smallest = min(captures, key=lambda capture: float(np.abs(capture.samples["current_a"]).mean()))
    observer = Estimator(
        cell,
        ObserverSettings(law="improved"),
        identifier=None,
        voltage_resolution_v=VOLTAGE_STEP_V,
        initial_soc=smallest.soc,
    )
    run = adaptive_run(observer, smallest.samples)
    predictions = [predict(cell, c.samples, c.soc, a=run.average, lowest_soc=lowest_soc) for c in captures]
    curve = mean_of([series_resistance(cell, prediction) for prediction in predictions])
    return AdaptedElements(run, fit_series_resistance(curve, lowest_soc))
