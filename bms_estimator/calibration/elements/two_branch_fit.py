"""Coefficients a1..a15 of two RC pairs and a series resistance that are equivalent to an RC ladder at 25 C.

Each element is an exponential of SOC plus an offset, (2.5)-(2.9) of the thesis. delta1 (2.11) and delta2 (2.12) are the
SOCs below which the capacitances are negative.
"""

import numpy as np
from scipy.optimize import nnls

from bms_estimator.calibration.ocv.overpotential import linear_interpolation_matrix
from bms_estimator.kernels.cell_model.rc_ladder import RESISTANCES
from bms_estimator.kernels.kalman_filter.equivalent_circuit import LN_TAUS, SHORT_PAIRS
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import Capacitance, Ladder, Resistance

SOC = np.linspace(0.02, 1.0, 50)
"""SOC grid on which the curves are fitted to the resistances of the ladder."""
EXPONENTS = np.geomspace(1.0, 60.0, 60)
"""Candidate exponents b of A e^(-b SOC) + c."""
NEGLIGIBLE = 1e-4
"""Relative amplitude that replaces a fitted amplitude of 0. A cell file requires an amplitude above 0."""
MIN_FRACTION = 1e-4
"""Minimum resistance of a section, as a fraction of the sum. A cell file requires values above 0."""
MAX_DELTA = 0.01
"""Maximum delta1 and delta2. The capacitances are positive down to this SOC."""
SECTIONS = {"r_s": (0, 1), "r_ts": (1, 1 + SHORT_PAIRS), "r_tl": (1 + SHORT_PAIRS, RESISTANCES)}
"""First index, and index after the last, of the ladder's resistances whose sum each section of the cell file
contains."""


def cell_file_sections(ladder: Ladder) -> dict[str, Resistance | Capacitance]:
    """Return the five sections of a cell file that contain a1..a15."""
    total_ohm = (
        linear_interpolation_matrix(SOC, np.array(ladder.soc))
        @ (np.array(ladder.weak_ohm) + np.array(ladder.strong_ohm)).T
    )
    sections: dict[str, Resistance | Capacitance] = {}
    for name, (first_index, end_index) in SECTIONS.items():
        ohm = np.maximum(total_ohm[:, first_index:end_index].sum(axis=1), MIN_FRACTION * total_ohm.sum(axis=1))
        amplitude, exponent, offset = _exponential(ohm, 1.0)
        sections[name] = Resistance(amplitude_ohm=amplitude, exponent=exponent, offset_ohm=offset)
        if (
            name != "r_s"
        ):  # ln tau of the RC pair is the mean of ln tau of its ladder's RC pairs, weighted by resistance
            # the lower limit gives equal weights where all resistances are 0
            fraction = np.maximum(total_ohm[:, first_index:end_index], 1e-6 * total_ohm.sum(axis=1, keepdims=True))
            fraction /= fraction.sum(axis=1, keepdims=True)
            farad = np.exp(fraction @ LN_TAUS[first_index - 1 : end_index - 1]) / ohm
            amplitude, exponent, offset = _exponential(farad, -1.0)
            sections["c" + name[1:]] = Capacitance(amplitude_farad=amplitude, exponent=exponent, offset_farad=offset)
    return sections


def _exponential(values: Floats, sign: float) -> tuple[float, float, float]:
    """Fit ``sign`` A e^(-b SOC) + c to ``values`` by relative least squares; return A, b and c, all positive."""
    # residual, A, b and c; a constant if no exponent fits
    best = (np.inf, NEGLIGIBLE * float(np.median(values)), 10.0, float(np.median(values)))
    for exponent in EXPONENTS:
        curve = np.column_stack([sign * np.exp(-exponent * SOC), np.ones(SOC.size)]) / values[:, None]
        (amplitude, offset), residual = nnls(curve, np.ones(SOC.size))
        positive = sign > 0.0 or amplitude * np.exp(-exponent * MAX_DELTA) < offset
        if residual < best[0] and offset > 0.0 and positive:
            best = (float(residual), max(float(amplitude), NEGLIGIBLE * float(offset)), float(exponent), float(offset))
    return best[1:]
