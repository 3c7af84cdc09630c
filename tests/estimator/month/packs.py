"""True packs, with a cell file for each. The cells have eight overpotential processes and the OCV of real cells."""

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.sources.captures.replay import load_capture
from tests.estimator.anywhere.cases import OCV_STD_V, OXIDE, PHOSPHATE, own_file
from tests.estimator.anywhere.cycles import Cycle, total_ohm, true_curve
from tests.estimator.anywhere.truth import (
    ENERGY_J,
    GAS_CONSTANT,
    GRID,
    KELVIN,
    REFERENCE_K,
    TAPER_C,
    Truth,
    measured_curve,
)

CAPACITY_STD = 0.04
"""Std of ln of the true capacity over the declared one. Real cells differ from their data sheet by 2-6 %."""
RESISTANCE_RATIOS = (0.7, 2.0)
"""Range of the true resistances divided by those of the generic cell."""
FILE_TEMPERATURES_C = (25.0, 10.0, 0.0, -10.0)
"""Temperatures of the data of a cell's own file [C]."""
CHEMISTRIES = {
    "LG M50": "nmc",
    "NCR": "nca",
    "Leaf": "lmo",
    "LFP": "lfp",
    "PF": "nca",
    "A123": "lfp",
    "random LCO": "lco",
}
"""Generic cell file for each cell. "LFP" and "random LCO" have the curve of the generic cell with an error."""
REAL_CAPTURES = {
    "PF": ("panasonic18650pf/25_c20", "panasonic18650pf/25_c20"),
    "A123": ("a123/c30_dis_p25", "a123/c30_chg_p25"),
}
"""Slow discharge and slow charge of cells whose captures are not part of this repository."""


@dataclass(frozen=True)
class Pack:
    """True cell, its chemistry, and the capacity that its owner declares."""

    truth: Truth
    """Cell with its true capacity at the beginning."""
    chemistry: str
    declared_ah: float
    """Capacity in the cell file [Ah]."""

    def charger_v(self, temperature_c: float = 25.0) -> float:
        """Return the voltage limit at which the current has fallen to C/20 when the SOC reaches 1 [V]."""
        truth = self.truth
        inverse_k = (1.0 / (temperature_c + KELVIN) - 1.0 / REFERENCE_K) / GAS_CONSTANT
        ohm = float(truth.ohm[-1] @ np.exp(ENERGY_J * inverse_k))
        ocv_v = truth.ocv_v[-1] + truth.hysteresis_v[-1] + (temperature_c - 25.0) * truth.per_kelvin_v[-1]
        return float(ocv_v + TAPER_C * truth.capacity_ah * ohm)

    @property
    def generic_file(self) -> CellModel:
        """Generic cell file with the declared capacity."""
        return load_cell(self.chemistry, self.declared_ah)

    def own_file(self, rng: np.random.Generator) -> CellModel:
        """Return a cell file of another cell of this type, with the declared capacity."""
        kind = "lfp" if self.chemistry == "lfp" else "nmc"
        return own_file(self.truth, self.generic_file, OCV_STD_V[kind], FILE_TEMPERATURES_C, rng)


def generator(*names: str | int) -> np.random.Generator:
    """Return a random generator that depends on names and seeds, equal on every machine."""
    return np.random.default_rng([zlib.crc32(str(name).encode()) for name in names])


def draw_pack(cell: str, declared_ah: float, seed: int, data: Path) -> Pack:
    """Return the pack of one seed: its true capacity and its resistances are random."""
    rng = generator(cell, seed)
    chemistry = CHEMISTRIES[cell]
    base = PHOSPHATE if chemistry == "lfp" else OXIDE
    capacity_ah = declared_ah * float(np.exp(CAPACITY_STD * rng.standard_normal()))
    ratio = float(np.exp(rng.uniform(*np.log(RESISTANCE_RATIOS))))
    scale = ratio * total_ohm(load_cell(chemistry, declared_ah)) / base.ohm[GRID.size // 2].sum()
    ocv_v, hysteresis_v = open_circuit(cell, seed, data)
    return Pack(Truth(capacity_ah, ocv_v, base.per_kelvin_v, hysteresis_v, scale * base.ohm), chemistry, declared_ah)


def open_circuit(cell: str, seed: int, data: Path) -> tuple[Floats, Floats]:
    """Return OCV and hysteresis of a cell at ``GRID`` [V]."""
    if cell == "LFP":
        return PHOSPHATE.ocv_v, PHOSPHATE.hysteresis_v
    if cell == "LG M50":
        return measured_curve(), OXIDE.hysteresis_v
    if cell in ("NCR", "Leaf"):
        ocv = load_cell({"NCR": "ncr18650", "Leaf": "leaf"}[cell]).ocv
        assert isinstance(ocv, TableOcv)
        return PchipInterpolator(ocv.soc, ocv.ocv_v)(GRID), OXIDE.hysteresis_v
    if cell == "random LCO":
        return true_curve(Cycle("lco", "discharge", 1.0, 0.5, seed=seed)), OXIDE.hysteresis_v
    discharge, charge = REAL_CAPTURES[cell]
    low_v, high_v = (slow_curve(data / f"{name}.csv.gz", sign) for name, sign in ((discharge, 1), (charge, -1)))
    # a slight slope keeps the mean rising where both curves are flat
    mean_v = np.maximum.accumulate(0.5 * (low_v + high_v)) + 1e-5 * GRID
    if cell == "A123":
        return mean_v, np.maximum(0.5 * (high_v - low_v), 0.0)
    # half of the difference is hysteresis plus overpotential; the overpotential is negligible only for LFP at C/30
    return mean_v, OXIDE.hysteresis_v


def slow_curve(path: Path, sign: int) -> Floats:
    """Return the voltage of a slow discharge (``sign`` 1) or charge (-1) at ``GRID`` [V].

    The SOC is the counted charge divided by the total charge of this discharge or charge.
    """
    capture = load_capture(path)
    steps_s = np.diff(capture["time_s"], prepend=capture["time_s"][0])
    charge_ah = np.cumsum(capture["current_a"] * steps_s) / 3600.0
    is_load = np.sign(np.round(capture["current_a"], 3)) == sign
    fraction = np.abs(charge_ah[is_load] - charge_ah[is_load][0])
    fraction /= fraction[-1]
    curve_v: Floats = np.interp(1.0 - GRID if sign > 0 else GRID, fraction, capture["voltage_v"][is_load])
    return curve_v
