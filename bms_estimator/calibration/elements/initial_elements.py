"""Initial circuit elements of a cell from the rests of a relaxation test: one value of each element for all SOC.

A fit of a whole capture starts from these values. At the end of a load the voltage steps by i R_s and then rises in two
exponentials, which give the two RC pairs: (2.2) and (2.3) of the thesis with i = 0.

The prior for values that captures do not determine is the generic cell with the most similar open-circuit voltage.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from bms_estimator.calibration.cleaning.clean_capture import are_mismatched, remove_glitches
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest
from bms_estimator.kernels.cell_model.rc_ladder import (
    HIGH_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    arrhenius,
)
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel, generic_cells, load_cell
from bms_estimator.model.cell_sections import Capacitance, Ladder, Resistance, TableOcv
from bms_estimator.model.errors import UserError

SHORT_TAUS = np.geomspace(0.003, 0.05, 12)
"""Candidate time constants of the short RC pair, as fractions of the rest's duration."""
LONG_TAUS = np.geomspace(0.08, 0.7, 10)
"""Candidate time constants of the long RC pair, as fractions of the rest's duration."""
NEGLIGIBLE = 1e-6
"""Relative amplitude of the SOC dependence of an element. A cell file requires an amplitude above 0."""
ANY_EXPONENT = 10.0
"""Exponent of the SOC dependence, which has no effect with a negligible amplitude."""
MIN_SOC = 0.1
"""Minimum SOC of a rest that is used. The elements rise steeply below."""
MAX_SAMPLES = 1000
"""Maximum number of samples of a rest. Longer rests are thinned."""
MIN_OHM = 1e-5
"""Lower limit of a resistance [ohm]. A cell file requires values above 0."""


@dataclass(frozen=True)
class InitialElements:
    """Elements that do not depend on SOC.

    Attributes:
        r_s_ohm: Series resistance [ohm]. It includes all dynamics that are faster than the capture's sampling.
        r_ts_ohm: Resistance of the short RC pair [ohm].
        tau_ts_s: Time constant of the short RC pair [s].
        r_tl_ohm: Resistance of the long RC pair [ohm].
        tau_tl_s: Time constant of the long RC pair [s].
    """

    r_s_ohm: float
    r_ts_ohm: float
    tau_ts_s: float
    r_tl_ohm: float
    tau_tl_s: float

    @property
    def sections(self) -> dict[str, Resistance | Capacitance]:
        """Return the sections of a cell file."""
        return {
            "r_ts": _resistance(self.r_ts_ohm),
            "r_tl": _resistance(self.r_tl_ohm),
            "c_ts": _capacitance(self.tau_ts_s / self.r_ts_ohm),
            "c_tl": _capacitance(self.tau_tl_s / self.r_tl_ohm),
            "r_s": _resistance(self.r_s_ohm),
        }


def initial_elements(samples: SampleBlock, test: RelaxationTest, capacity_ah: float) -> InitialElements:
    """Return the median of each element over the rests of one test.

    Args:
        samples: Raw samples of ``test``, dtype ``SAMPLE``.
        test: Relaxation test with its rests.
        capacity_ah: Capacity that the SOC of ``test`` was counted against [Ah].

    Raises:
        UserError: No rest follows a load.
    """
    good = remove_glitches(samples, test.name)
    good = good[~are_mismatched(good)]  # the first sample of a rest would show a resistance of 0
    elements_of_rests = []
    soc = test.start_soc
    for rest in test.rests:
        discharged_as = (soc - rest.soc) * capacity_ah * 3600.0
        soc = rest.soc
        first = int(np.searchsorted(good["time_s"], rest.start_s))
        last = int(np.searchsorted(good["time_s"], rest.start_s + rest.duration_s, side="right"))
        current_a = float(good["current_a"][first - 1]) if first else 0.0
        if discharged_as > 0.0 and current_a > 0.0 and rest.soc > MIN_SOC:
            elements_of_rests.append(
                _elements_from_rest(good[first:last], float(good["voltage_v"][first - 1]), current_a, discharged_as)
            )
    if not elements_of_rests:
        raise UserError(f"{test.name}: none of its {len(test.rests)} rests follows a discharge above SOC {MIN_SOC}")
    return InitialElements(*(float(x) for x in np.median(np.array(elements_of_rests), axis=0)))


def _elements_from_rest(
    rest: SampleBlock, last_loaded_v: float, current_a: float, discharged_as: float
) -> tuple[float, ...]:
    """Fit R_s, R_ts, tau_ts, R_tl and tau_tl to one rest.

    Args:
        rest: Samples of the rest.
        last_loaded_v: Last voltage before the rest [V].
        current_a: Current before the rest [A].
        discharged_as: Charge drawn since the previous rest [As].
    """
    rest = rest[:: -(-rest.size // MAX_SAMPLES)]  # rounded up
    time_s = rest["time_s"] - rest["time_s"][0]
    duration_s = float(time_s[-1])
    fits = []
    for tau_ts_s in SHORT_TAUS * duration_s:
        for tau_tl_s in LONG_TAUS * duration_s:
            basis = np.column_stack([np.ones_like(time_s), -np.exp(-time_s / tau_ts_s), -np.exp(-time_s / tau_tl_s)])
            coefficients, norm = nnls(basis, rest["voltage_v"])
            fits.append((float(norm), tau_ts_s, tau_tl_s, coefficients))
    _, tau_ts_s, tau_tl_s, (ocv_v, short_v, long_v) = min(fits, key=lambda fit: fit[0])
    load_s = discharged_as / current_a
    return (
        max((ocv_v - short_v - long_v - last_loaded_v) / current_a, MIN_OHM),
        _rc_resistance(short_v, current_a, load_s, tau_ts_s),
        tau_ts_s,
        _rc_resistance(long_v, current_a, load_s, tau_tl_s),
        tau_tl_s,
    )


def _rc_resistance(voltage_v: float, current_a: float, load_s: float, tau_s: float) -> float:
    """Return the resistance of an RC pair that a load of duration ``load_s`` has charged to ``voltage_v``, by (2.2) [ohm]."""
    charged_fraction = -float(np.expm1(-load_s / tau_s))
    return max(voltage_v / (current_a * charged_fraction), MIN_OHM)


def _resistance(ohm: float) -> Resistance:
    return Resistance(amplitude_ohm=NEGLIGIBLE * ohm, exponent=ANY_EXPONENT, offset_ohm=ohm)


def _capacitance(farad: float) -> Capacitance:
    return Capacitance(amplitude_farad=NEGLIGIBLE * farad, exponent=ANY_EXPONENT, offset_farad=farad)


COMPARED_SOC = 0.1, 0.95
"""Lower and upper end of the SOC range in which OCV curves are compared. Outside, the steep ends would dominate the
difference."""
RESTS_STD = 0.35
"""Relative standard deviation of a ladder with the total resistance from rests and the distribution of a typical
cell."""


def nearest_generic_cell(soc: Floats, ocv_v: Floats, capacity_ah: float, series_count: int) -> CellModel:
    """Return the generic cell with the nearest OCV curve, scaled to the capacity and the number of cells in series.

    Args:
        soc: Shape (n,), increasing.
        ocv_v: Open-circuit voltage there [V].
        capacity_ah: Capacity of the returned cell [Ah].
        series_count: Cells in series.
    """
    cells = [load_cell(name, capacity_ah).pack(series_count, 1) for name in generic_cells()]
    return min(cells, key=lambda cell: ocv_rms_difference_v(cell, soc, ocv_v))


def ocv_rms_difference_v(cell: CellModel, soc: Floats, ocv_v: Floats) -> float:
    """Return the RMS difference between a generic cell's OCV and a curve at ``COMPARED_SOC`` [V].

    Args:
        cell: The generic cell.
        soc: Shape (n,), increasing.
        ocv_v: Open-circuit voltage there [V].
    """
    inside = (soc > COMPARED_SOC[0]) & (soc < COMPARED_SOC[1])
    curve_v = np.interp(soc[inside], *curve(cell, "ocv_v"))
    return float(np.sqrt(np.mean((curve_v - ocv_v[inside]) ** 2)))


def curve(cell: CellModel, column: str) -> tuple[Floats, Floats]:
    """Return SOC and a column of a generic cell's OCV table."""
    ocv = cell.ocv
    if not isinstance(ocv, TableOcv):
        raise TypeError(f"{cell.cell.name}: a generic cell must have an OCV table")
    return np.array(ocv.soc), np.array(getattr(ocv, column))


def scaled_generic_ladder(
    generic: CellModel, rests: InitialElements | None, temperature_c: float = REFERENCE_C
) -> Ladder:
    """Return the generic resistances over SOC, scaled to the resistances from rests.

    Rests do not show the growth of resistances in the cold and near empty. Therefore the growth of the
    generic cell is kept.

    Args:
        generic: Result of ``nearest_generic_cell``.
        rests: Elements from the rests; None: without scaling.
        temperature_c: Temperature of the rests [C].
    """
    ladder = generic.ladder
    if ladder is None:
        raise TypeError(f"{generic.cell.name}: a generic cell must have an RC ladder")
    if rests is None:
        return ladder
    weak_ohm, strong_ohm = np.array(ladder.weak_ohm), np.array(ladder.strong_ohm)
    total_ohm = (
        arrhenius(LOW_ACTIVATION_ENERGY, temperature_c) * weak_ohm
        + arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c) * strong_ohm
    )
    mid_soc_ohm = np.array([np.interp(0.5, ladder.soc, row) for row in total_ohm])
    # index 0 is the series resistance, the others are the RC pairs
    scale = np.full(mid_soc_ohm.size, (rests.r_ts_ohm + rests.r_tl_ohm) / mid_soc_ohm[1:].sum())
    scale[0] = rests.r_s_ohm / mid_soc_ohm[0]
    rows = {
        name: tuple(tuple(float(f"{ohm:.4g}") for ohm in row) for row in scale[:, None] * ohms)
        for name, ohms in (("weak_ohm", weak_ohm), ("strong_ohm", strong_ohm))
    }
    return ladder.model_copy(update={**rows, "std": RESTS_STD})
