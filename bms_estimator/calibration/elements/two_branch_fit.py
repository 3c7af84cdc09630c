"""a1..a15 of the two branches that a ladder amounts to at 25 C, (2.5)-(2.9)."""

import numpy as np
from scipy.optimize import nnls

from bms_estimator.calibration.ocv.overpotential import linear_interpolation_matrix
from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES
from bms_estimator.kernels.kalman_filter.equivalent_circuit import LN_TAUS, SHORT
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import Capacitance, Ladder, Resistance

SOC = np.linspace(0.02, 1.0, 50)
"""SOC at which the curves should match those of the RC network."""
EXPONENTS = np.geomspace(1.0, 60.0, 60)
NEGLIGIBLE = 1e-4
"""Fraction of the offset that replaces a zero amplitude, which the function needs."""
FARTHEST_DELTA = 0.01
"""Capacitances are positive down to this SOC, (2.11), (2.12)."""
SECTIONS = {"r_s": (0, 1), "r_ts": (1, 1 + SHORT), "r_tl": (1 + SHORT, RESISTANCES)}
"""Section of the cell file -> which resistances of the ladder it sums up."""


def cell_file_sections(ladder: Ladder) -> dict[str, Resistance | Capacitance]:
    """Return the five sections of a cell file."""
    total = (
        linear_interpolation_matrix(SOC, np.array(ladder.soc))
        @ (np.array(ladder.weak_ohm) + np.array(ladder.strong_ohm)).T
    )
    made: dict[str, Resistance | Capacitance] = {}
    for name, (first, end) in SECTIONS.items():
        ohm = np.maximum(total[:, first:end].sum(axis=1), 1e-4 * total.sum(axis=1))
        amplitude, exponent, offset = _exponential(ohm, 1.0)
        made[name] = Resistance(amplitude_ohm=amplitude, exponent=exponent, offset_ohm=offset)
        if name != "r_s":
            share = np.maximum(
                total[:, first:end], 1e-6 * total.sum(axis=1, keepdims=True)
            )  # none reported: assume equal ones
            share /= share.sum(axis=1, keepdims=True)
            farad = np.exp(share @ LN_TAUS[first - 1 : end - 1]) / ohm
            amplitude, exponent, offset = _exponential(farad, -1.0)
            made["c" + name[1:]] = Capacitance(amplitude_farad=amplitude, exponent=exponent, offset_farad=offset)
    return made


def _exponential(values: Floats, sign: float) -> tuple[float, float, float]:
    """Amplitude, exponent and offset of sign A e^(-b SOC) + c nearest to ``values``, relative, all positive."""
    best = (np.inf, NEGLIGIBLE * float(np.median(values)), 10.0, float(np.median(values)))
    for exponent in EXPONENTS:
        curve = np.column_stack([sign * np.exp(-exponent * SOC), np.ones(SOC.size)]) / values[:, None]
        (amplitude, offset), left = nnls(curve, np.ones(SOC.size))
        positive = sign > 0.0 or amplitude * np.exp(-exponent * FARTHEST_DELTA) < offset
        if left < best[0] and offset > 0.0 and positive:
            best = (float(left), max(float(amplitude), NEGLIGIBLE * float(offset)), float(exponent), float(offset))
    return best[1:]
