"""Terminal voltage of Chen and Mora's model with constant parameters a1..a15 under a measured current.

Section 5.3 and chapter 6 of the thesis validate the parameters in this way. Numbers in parentheses are equations of the
thesis. The dynamic model has elements that depend on SOC. The static model has constant elements, which are the values
at one SOC. In both, E_o depends on SOC.
"""

from dataclasses import dataclass, fields

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import remove_glitches, soc_by_counting
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, delta, ocv_of_each, r_s, r_tl, r_ts, simulate_cell
from bms_estimator.model.arrays import Floats, Masks, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.model.errors import UserError

GRID = np.linspace(0.0, 1.0, 4001)
"""SOC grid on which E_o(SOC) is inverted."""
EMPTY_SOC = 0.0
"""SOC at which a prediction ends. The curves of the model are undefined below."""
DELTA_FACTOR = 1.05
"""Ratio of the SOC at which a prediction ends to delta1 or delta2, the SOCs at which a capacitance is zero."""
DELTA_MARGIN = 1e-4
"""Additional SOC above delta1 and delta2 at which a prediction ends."""
JUMP_FRACTION = 0.1
"""Minimum change of the current between two samples of a current jump, as a fraction of the largest current."""


@dataclass(frozen=True)
class Prediction:
    """Measured and predicted voltage of one capture without glitches. All arrays have shape (n,).

    Attributes:
        time_s: Times on the capture's clock [s].
        current_a: Current, positive on discharge [A].
        voltage_v: Measured voltage [V].
        predicted_v: Predicted voltage [V].
        soc: SOC by coulomb counting, 0..1.
        overpotential_v: x2 + x3, the voltages of both RC pairs of the model [V].
    """

    time_s: Floats
    current_a: Floats
    voltage_v: Floats
    predicted_v: Floats
    soc: Floats
    overpotential_v: Floats

    @property
    def error_v(self) -> Floats:
        """Measured less predicted voltage, (3.15) [V]."""
        return self.voltage_v - self.predicted_v

    @property
    def error_percent(self) -> Floats:
        """Absolute error relative to the measured voltage [%]."""
        return 100.0 * np.abs(self.error_v) / self.voltage_v

    @property
    def mean_percent(self) -> float:
        """Mean error as in Table 11 [%]."""
        return float(self.error_percent.mean())

    @property
    def aligned(self) -> Masks:
        """Mask without the first samples after current jumps. Their voltage is often from before the jump."""
        jump_a = np.abs(np.diff(self.current_a, prepend=self.current_a[0]))
        return np.asarray(jump_a <= JUMP_FRACTION * np.abs(self.current_a).max())

    @property
    def max_percent(self) -> float:
        """Largest error over the samples that are ``aligned`` [%]."""
        return float(self.error_percent[self.aligned].max())

    def above(self, soc: float) -> "Prediction":
        """Return the prediction up to the sample at which SOC falls to ``soc``; at least the first sample."""
        end = max(int(np.argmax(np.r_[self.soc <= soc, True])), 1)
        return Prediction(**{column.name: getattr(self, column.name)[:end] for column in fields(self)})


def predict(
    cell: CellModel, samples: SampleBlock, initial_soc: float, *, a: Floats | None = None, lowest_soc: float = EMPTY_SOC
) -> Prediction:
    """Simulate the model with constant parameters over a capture that starts at rest.

    Args:
        cell: Capacity, OCV and elements. ``a``, if given, replaces the elements.
        samples: Raw samples, dtype ``SAMPLE``.
        initial_soc: SOC 0..1 at the first sample.
        a: a1..a15 at index 1..15; None: the values of ``cell``.
        lowest_soc: SOC below which the prediction ends. It also ends just above delta1 and delta2, the SOCs below which
            a capacitance of the model is negative.

    Raises:
        UserError: No sample is good, or SOC is too low at the first one.
    """
    name = f"capture for {cell.cell.name}"
    good = remove_glitches(samples, name)
    elements = np.zeros(22)  # a1..a21 at index 1..21
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
    # with a16..a21 = 0 the open-circuit voltage is 0, so that the simulated voltage is -x2 - x3 - i R_s
    without_ocv_v, soc = simulate_cell(start, time_s, current_a, capacity_as, elements)
    without_r_s = elements.copy()
    without_r_s[13] = without_r_s[15] = 0.0
    rc_pairs_v, _ = simulate_cell(start, time_s, current_a, capacity_as, without_r_s)  # -x2 - x3
    return Prediction(
        time_s=time_s,
        current_a=current_a,
        voltage_v=np.ascontiguousarray(good["voltage_v"]),
        predicted_v=open_circuit(cell, soc) + without_ocv_v,
        soc=soc,
        overpotential_v=-rc_pairs_v,
    )


def open_circuit(cell: CellModel, soc: Floats) -> Floats:
    """Return the open-circuit voltage E_o(SOC) of the cell, interpolated as in the kernels [V]."""
    return ocv_of_each(soc, *ocv_grid(cell))


def static_elements(a: Floats, soc: float) -> Floats:
    """Return a1..a15 of the static model of chapter 6, whose elements have the values at ``soc`` for every SOC."""
    frozen = np.array(a)
    # index of each element's offset; its amplitude is two before
    for offset, element in ((3, r_ts), (6, r_tl), (9, c_ts), (12, c_tl), (15, r_s)):
        frozen[offset] = element(soc, a)
        frozen[offset - 2] = 1e-30  # an amplitude of zero would leave delta1, delta2 undefined
    return frozen


def _unstable_below(a: Floats) -> float:
    """Return the SOC below which a capacitance is negative, (2.11), (2.12), with a margin; 0 if none is negative."""
    unstable_soc = max(delta(a[i + 1], a[i + 2], a[i]) for i in (7, 10))
    return DELTA_FACTOR * unstable_soc + DELTA_MARGIN if unstable_soc > 0.0 else 0.0


def soc_by_interpolation(cell: CellModel, run: Prediction) -> tuple[Floats, Floats]:
    """Return SOC by the measured voltage and the model's overpotentials.

    E_o = y + x2 + x3 + i R_s (2.4) is inverted to SOC. R_s and the overpotentials are taken at the counted SOC, because
    they depend on SOC only weakly.

    Returns:
        SOC (0..1) and E_o [V], each of the run's shape. Outside the curve, the nearest end gives the SOC.
    """
    a = cell.a
    ohmic_v = run.current_a * np.array([r_s(x, a) for x in run.soc])
    e_o = run.voltage_v + run.overpotential_v + ohmic_v  # (2.4) solved for E_o
    return np.interp(e_o, open_circuit(cell, GRID), GRID), e_o
