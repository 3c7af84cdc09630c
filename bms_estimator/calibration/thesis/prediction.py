"""Terminal voltage of a model with frozen parameters under a measured current: validation (5.3), chapter 6.

The dynamic model has elements that follow SOC; the static one has them frozen at one SOC. Both keep E_o(SOC).
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration.cleaning.rests import remove_glitches, soc_by_counting
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, delta, ocv, r_s, r_tl, r_ts, simulate_cell
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

GRID = np.linspace(0.0, 1.0, 4001)

EMPTY = 0.0
"""SOC where a prediction ends: below it the curves of the model mean nothing."""
JUMP = 0.1
"""A change of the current between two samples is a jump above this share of the largest current."""


@dataclass(frozen=True)
class Prediction:
    """Measured and predicted voltage of one capture, glitches left out. All arrays have shape (n,).

    Attributes:
        time_s: On the capture's clock [s].
        current_a: Positive on discharge [A].
        voltage_v: Measured [V].
        predicted_v: Predicted voltage [V].
        soc: SOC by coulomb counting, 0..1.
        overpotential_v: x2 + x3 of the model [V].
    """

    time_s: Floats
    current_a: Floats
    voltage_v: Floats
    predicted_v: Floats
    soc: Floats
    overpotential_v: Floats

    @property
    def error_v(self) -> Floats:
        """Measured less predicted, (3.15) [V]."""
        return self.voltage_v - self.predicted_v

    @property
    def error_percent(self) -> Floats:
        """Magnitude of the error, of the measured voltage [%]."""
        return 100.0 * np.abs(self.error_v) / self.voltage_v

    @property
    def mean_percent(self) -> float:
        """Mean error as in Table 11 [%]."""
        return float(self.error_percent.mean())

    @property
    def aligned(self) -> NDArray[np.bool_]:
        """All samples but the first after a jump of the current: many a logger's voltage there is from before it."""
        jump_a = np.abs(np.diff(self.current_a, prepend=self.current_a[0]))
        return np.asarray(jump_a <= JUMP * np.abs(self.current_a).max())

    @property
    def max_percent(self) -> float:
        """Largest error over the samples that are ``aligned`` [%]."""
        return float(self.error_percent[self.aligned].max())

    def above(self, soc: float) -> "Prediction":
        """Return the samples until SOC falls to ``soc``; at least the first sample."""
        end = max(int(np.argmax(np.r_[self.soc <= soc, True])), 1)
        return Prediction(**{column.name: getattr(self, column.name)[:end] for column in fields(self)})


def predict(
    cell: CellModel, samples: SampleBlock, initial_soc: float, *, a: Floats | None = None, lowest_soc: float = EMPTY
) -> Prediction:
    """Run the frozen model over a capture, from rest.

    Args:
        cell: Capacity and OCV, and the elements when ``a`` is left out.
        samples: Dtype ``SAMPLE``, raw.
        initial_soc: SOC 0..1 at the first sample.
        a: a1..a15 at index 1..15, to take in place of the cell's.
        lowest_soc: The prediction ends where SOC falls below it; the model's delta1, delta2 end it as well.

    Raises:
        UserError: No sample is good, or SOC is too low from the first one on.
    """
    name = f"capture for {cell.cell.name}"
    good = remove_glitches(samples, name)
    elements = np.zeros(22)
    elements[1:16] = (cell.a if a is None else a)[1:16]
    floor = max(lowest_soc, _unstable_below(elements))
    soc = soc_by_counting(good, cell.cell.capacity_ah, initial_soc)
    below = np.flatnonzero(soc < floor)
    if below.size and below[0] == 0:
        raise UserError(f"{name}: SOC is {soc[0]:.3f} at the first sample, and the prediction ends below {floor:.3f}")
    good = good[: below[0] if below.size else good.size]
    time_s, current_a = (np.ascontiguousarray(good[name]) for name in ("time_s", "current_a"))
    capacity_as = cell.cell.capacity_ah * 3600.0
    start = (initial_soc, 0.0, 0.0)
    drop_v, soc = simulate_cell(start, time_s, current_a, capacity_as, elements)  # -x2 - x3 - i R_s: a16..a21 are 0
    ohmic = elements.copy()
    ohmic[13] = ohmic[15] = 0.0
    relaxing_v, _ = simulate_cell(start, time_s, current_a, capacity_as, ohmic)
    return Prediction(
        time_s=time_s,
        current_a=current_a,
        voltage_v=np.ascontiguousarray(good["voltage_v"]),
        predicted_v=open_circuit(cell, soc) + drop_v,
        soc=soc,
        overpotential_v=-relaxing_v,
    )


def open_circuit(cell: CellModel, soc: Floats) -> Floats:
    """E_o(SOC) of the cell [V], on the kernels' curve."""
    grid = ocv_grid(cell)
    return np.array([ocv(x, *grid) for x in soc])


def static_elements(a: Floats, soc: float) -> Floats:
    """a1..a15 of a model with constant elements, those at ``soc``: the static model of chapter 6."""
    frozen = np.array(a)
    for offset, element in ((3, r_ts), (6, r_tl), (9, c_ts), (12, c_tl), (15, r_s)):
        frozen[offset] = element(soc, a)
        frozen[offset - 2] = 1e-30  # an amplitude of zero would leave delta1, delta2 undefined
    return frozen


def _unstable_below(a: Floats) -> float:
    """SOC below which a capacitance is negative, (2.11), (2.12); 0 when none is."""
    worst = max(delta(a[i + 1], a[i + 2], a[i]) for i in (7, 10))
    return 1.05 * worst + 1e-4 if worst > 0.0 else 0.0


def soc_by_interpolation(cell: CellModel, run: Prediction) -> tuple[Floats, Floats]:
    """SOC from the measured voltage and the model's overpotentials.

    E_o = y + x2 + x3 + i R_s (2.4), looked up in the inverse of E_o(SOC). R_s and the overpotentials depend on SOC but
    weakly, they are taken at the counted one.

    Returns:
        SOC (0..1) and E_o [V], each of the run's shape. Outside the curve the nearest end of it.
    """
    a = cell.a
    ohmic_v = run.current_a * np.array([r_s(x, a) for x in run.soc])
    e_o = run.voltage_v + run.overpotential_v + ohmic_v  # (2.4) solved for E_o
    return np.interp(e_o, open_circuit(cell, GRID), GRID), e_o
