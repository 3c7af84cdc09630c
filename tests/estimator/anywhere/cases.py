"""Short simulated captures of typical loads and conditions, identical on every machine.

The estimator starts in mid-load with an SOC 0.2 too low or 0.2 too high. The RC ladder of the cell file is fitted to
the true impedance at the temperatures of the file. The file has errors of the size that it declares: an OCV that is off
by some millivolts and along the SOC axis, resistances of another cell of the same type, and a capacity error of one
percent.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from bms_estimator.calibration.ocv.hysteresis import RESTED_FRACTION_STD
from bms_estimator.kernels.cell_model.rc_ladder import HIGH_ACTIVATION_ENERGY, LOW_ACTIVATION_ENERGY, TAU_S, arrhenius
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import Ladder, TableOcv
from tests.estimator.anywhere.truth import (
    GRID,
    Truth,
    curve_of,
    impedance,
    measured_curve,
    resistances,
    simulate,
    smooth,
)

OXIDE = Truth(
    capacity_ah=3.0,
    ocv_v=measured_curve(),
    per_kelvin_v=1e-4 * np.sin(6.0 * GRID) - 1e-4,
    hysteresis_v=0.003 + 0.012 * np.exp(-GRID / 0.15),
    ohm=resistances((22.0, 4.0, 9.0, 6.0, 7.0, 9.0, 8.0, 5.0)),
)
PHOSPHATE = Truth(
    capacity_ah=2.0,
    ocv_v=curve_of("lfp") + 0.002 * np.sin(9.0 * GRID),
    per_kelvin_v=8e-5 * np.cos(4.0 * GRID),
    hysteresis_v=0.010 + 0.004 * np.sin(5.0 * GRID),
    ohm=resistances((12.0, 3.0, 5.0, 4.0, 4.0, 5.0, 6.0, 4.0)),
)
NODES = np.array([0, 20, 40, 60, 80, 120, 160, 200, 240, 280, 320, 360, 400])
"""SOC nodes of the resistances in the cell file, as indices of ``GRID``."""
OCV_NODES = np.concatenate([np.arange(0, 40, 4), np.arange(40, 401, 10)])
"""SOC nodes of the OCV in the cell file, as indices of ``GRID``."""
RAD_S = 1.0 / np.geomspace(0.1, 4000.0, 40)
"""Angular frequencies at which the ladder is fitted to the impedance [1/s]."""
WEAK_SHARE = np.array([0.7, 0.3, 0.3, 0.4, 0.5, 0.5, 0.5])
"""Fraction of each resistance that depends weakly on temperature, in a cell file with data of 25 C only: R_s first, then the RC
pairs."""
R_STD = 0.1
"""Std of the ln of a random factor that all resistances of the cell file have in common."""
SHAPE_STD = 0.05
"""Std of the ln of a further random factor, which each resistance has at each SOC."""
STOP_PROBABILITY = 0.15
"""Fraction of the levels of a drive at which the vehicle stands."""
OCV_STD_V = {"nmc": 0.004, "lfp": 0.002}
"""Std of the voltage error of the cell file's OCV [V]."""
OCV_STD_SOC = 0.007
"""Std of the error of the cell file's OCV along the SOC axis."""
OCV_LENGTH_SOC = 0.15
"""Correlation length of both errors of the OCV [SOC]."""
STEADY_C = 0.5
"""Current at which the ladder is fitted to the impedance [C]."""
HOUR_S = 3600
"""Seconds of an hour."""
VOLT_STEP, AMPERE_STEP, KELVIN_STEP = 1e-3, 1e-3, 0.1
"""Resolution of the sensors [V], [A] and [K]."""


@dataclass(frozen=True)
class Case:
    """Parameters of one capture and of the estimator's cell file."""

    name: str
    truth: Truth = OXIDE
    load: Literal["drive", "constant", "rest"] = "drive"
    """Kind of load: a drive, a constant load, or a drive with 30 min of rest from 5 min after switch-on."""
    load_c: float = 0.5
    """Mean of the load [C]."""
    temperature_c: float = 25.0
    temperature_rise_k: float = 0.0
    """Temperature rise over the capture [K]."""
    rate_hz: float = 1.0
    hours: float = 1.3
    load_before_h: float = 0.5
    """Duration of the load before the estimator starts; 0: from rest."""
    soc: float = 0.9
    """SOC at the start of the load, from rest; 1: just charged."""
    file_temperatures_c: tuple[float, ...] | Literal["generic"] = (25.0, 10.0, 0.0, -10.0)
    """Temperatures at which the data of the cell file were measured [C], or "generic" for a generic cell file."""
    current_gain: float = 1.0
    """Measured current divided by the true current."""
    offset_a: float = 0.0
    """Offset of the current sensor [A]."""
    file_capacity_ratio: float = 1.01
    """Capacity in the cell file divided by the true capacity."""
    file_ocv_error_ratio: float = 1.0
    """Error of the cell file's OCV divided by a typical error. The error limits the accuracy of a learned capacity."""
    weakest_cell_ratio: float = 1.0
    """Below 1: six cells in series, one with this fraction of the capacity of the others."""
    has_temperature: bool = True
    """True: the samples contain a temperature."""
    self_heating_k_per_w: float = 0.0
    """Temperature rise for a loss of 1 W [K]."""
    after_s: float = 900.0
    """Time after the first sample from which on the run is scored [s]."""
    seed: int = 1
    """Seed of load, cell file and noise."""


FILE_OF_25_C = {"file_temperatures_c": (25.0,)}
"""Cell file with data of 25 C only."""
LFP = {"truth": PHOSPHATE, "file_temperatures_c": (25.0, 5.0, -15.0)}
CHARGES = {"load": "constant", "load_c": -0.2, "soc": 0.15, "hours": 3.0}
WARMS = {"self_heating_k_per_w": 15.0, "temperature_c": 20.0, "hours": 0.4, "load_before_h": 0.2}
"""Cell that warms itself in a room of 20 C."""
CASES: tuple[Case, ...] = (
    Case("oxide 25C", seed=1),
    Case("oxide 25C again", seed=2),
    Case("oxide 10C", temperature_c=10.0, seed=3),
    Case("oxide 10Hz", rate_hz=10.0, hours=0.7, seed=4),
    Case("constant 0.5C", load="constant"),
    Case("constant 0.25C", load="constant", load_c=0.25, load_before_h=1.0),
    Case("oxide 0C", temperature_c=0.0, load_c=0.4, seed=5),
    Case("oxide -10C", temperature_c=-10.0, load_c=0.35, seed=6),
    Case("oxide -20C", temperature_c=-20.0, load_c=0.25, seed=7),
    Case("rest at -10C", load="rest", temperature_c=-10.0, load_c=0.35, after_s=2400.0, seed=8),
    Case("full at -10C", temperature_c=-10.0, load_c=0.35, soc=1.0, load_before_h=0.0, seed=9),
    Case("knows 25C at 40C", temperature_c=40.0, **FILE_OF_25_C, seed=10),
    Case("knows 25C at 10C", temperature_c=10.0, **FILE_OF_25_C, seed=11),
    Case("knows 25C at 0C", temperature_c=0.0, load_c=0.4, **FILE_OF_25_C, seed=12),
    Case("knows 25C at -10C", temperature_c=-10.0, load_c=0.35, **FILE_OF_25_C, seed=13),
    Case("knows 25C at -20C", temperature_c=-20.0, load_c=0.25, **FILE_OF_25_C, seed=14),
    Case("rising 5..25C", temperature_c=5.0, temperature_rise_k=20.0, seed=15),
    Case("no sensor at 15C", temperature_c=15.0, has_temperature=False, seed=16),
    Case("warms itself", load="constant", load_c=1.2, has_temperature=False, **WARMS, seed=31),
    Case(
        "kept cool", load_c=1.0, hours=0.6, temperature_c=20.0, has_temperature=False, self_heating_k_per_w=1.0, seed=32
    ),
    Case("LFP full 25C", **LFP, soc=1.0, load_before_h=0.0, seed=17),
    Case("LFP full -10C", **LFP, temperature_c=-10.0, load_c=0.4, soc=1.0, load_before_h=0.0, seed=18),
    Case("LFP full -25C", **LFP, temperature_c=-25.0, load_c=0.2, soc=1.0, load_before_h=0.0, seed=38),
    Case("LFP full 45C", **LFP, temperature_c=45.0, soc=1.0, load_before_h=0.0, seed=39),
    Case("LFP cut 25C", **LFP, hours=1.5, seed=19),
    Case("LFP charging", **LFP, **CHARGES, seed=34),
    Case("LFP charging 0C", **LFP, **CHARGES, temperature_c=0.0, seed=37),
    Case("oxide charging", **CHARGES, seed=36),
    Case("LFP cut 0C", **LFP, temperature_c=0.0, hours=1.5, seed=20),
    Case("generic nmc", file_temperatures_c="generic", seed=21),
    Case("generic nmc 0C", file_temperatures_c="generic", temperature_c=0.0, load_c=0.4, seed=33),
    Case("generic lfp", truth=PHOSPHATE, file_temperatures_c="generic", soc=1.0, load_before_h=0.0, seed=22),
    Case("gain +5%", current_gain=1.05, seed=23),
    Case("offset +50mA", offset_a=0.05, seed=24),
    Case("offset -50mA", offset_a=-0.05, seed=25),
    Case("capacity +5%", file_capacity_ratio=1.05, seed=26),
    Case("capacity -5%", file_capacity_ratio=0.95, seed=27),
    Case("capacity +20%", file_capacity_ratio=1.2, seed=28),
    Case("capacity -20%", file_capacity_ratio=0.8, seed=29),
    Case("6S one cell -10%", weakest_cell_ratio=0.9, seed=30),
    Case("6S one cell -20%", weakest_cell_ratio=0.8, seed=35),
)
"""Cases of the summary, which names them. In "full" cases the cell has just been charged; "cut" captures begin in mid-load; in
"knows 25C" cases the cell file has only data of 25 C."""
SOC_ERRORS = (-0.2, 0.2)
"""Errors of the initial SOC."""


@dataclass(frozen=True)
class Capture:
    """Samples for the estimator, its cell file, and the true SOC."""

    samples: SampleBlock
    soc: Floats
    """True SOC of the weakest cell at each sample."""
    cell: CellModel


def load_a(case: Case, seconds: int) -> Floats:
    """Return the current of a case at 1 Hz [A].

    A drive consists of random levels of some seconds, stops, and regeneration, which cold cells do not accept.
    """
    rng = np.random.default_rng(case.seed)
    one_c = case.truth.capacity_ah
    if case.load == "constant":
        return np.full(seconds, case.load_c * one_c)
    level = rng.normal(case.load_c, 0.9 * case.load_c + 0.1, seconds)
    level[rng.random(seconds) < STOP_PROBABILITY] = 0.0
    level = np.clip(level, -0.5 if case.temperature_c >= 10.0 else 0.0, 3.0)
    levels_s = rng.exponential(20.0, seconds).astype(int) + 2
    current_a = one_c * np.repeat(level, levels_s)[:seconds]
    if case.load == "rest":
        begin = round(HOUR_S * case.load_before_h) + 300  # 5 min after switch-on
        current_a[begin : begin + 1800] = 0.0
    return current_a


def capture(case: Case, current_a: Floats | None = None) -> Capture:
    """Simulate a capture of one case. If ``current_a`` is given, it replaces the load, with ``case.rate_hz`` samples a second [A]."""
    assert not (case.has_temperature and case.self_heating_k_per_w), "a sensor would have the temperature of the room"
    rng = np.random.default_rng(1000 + case.seed)
    if current_a is None:
        current_a = np.repeat(load_a(case, round(HOUR_S * (case.load_before_h + case.hours))), round(case.rate_hz))
    dt_s = 1.0 / case.rate_hz
    time_s = dt_s * np.arange(current_a.size)
    temperature_c = case.temperature_c + case.temperature_rise_k * time_s / time_s[-1]
    cells = 1 if case.weakest_cell_ratio == 1.0 else 6  # in series
    voltage_v, soc = np.zeros(time_s.size), np.ones(time_s.size)
    for n in range(cells):
        t = replace(case.truth, capacity_ah=case.truth.capacity_ah * (case.weakest_cell_ratio if n == 0 else 1.0))
        curves = t.ocv_v, t.per_kelvin_v, t.hysteresis_v, t.ohm
        hysteresis = 1.0 if case.soc == 1.0 else -1.0  # a full cell was charged, others were discharged
        cell_v, cell_soc = simulate(
            dt_s, current_a, temperature_c, case.soc, hysteresis, t.capacity_ah, *curves, case.self_heating_k_per_w
        )
        voltage_v, soc = voltage_v + cell_v, np.minimum(soc, cell_soc)
    begin = int(np.searchsorted(time_s, HOUR_S * case.load_before_h))
    empty = (soc < 0.02) | (voltage_v < 2.5 * cells if case.truth is OXIDE else voltage_v < 2.0)
    end = int(np.argmax(empty)) if empty.any() else time_s.size
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    samples["time_s"] = time_s
    measured_a = case.current_gain * current_a + case.offset_a + rng.normal(0.0, 2e-3, time_s.size)
    samples["current_a"] = np.round(measured_a / AMPERE_STEP) * AMPERE_STEP
    measured_v = voltage_v + rng.normal(0.0, 5e-4 * np.sqrt(cells), time_s.size)
    samples["voltage_v"] = np.round(measured_v / VOLT_STEP) * VOLT_STEP
    measured_c = temperature_c + rng.normal(0.0, 0.1, time_s.size)
    samples["temperature_c"] = np.round(measured_c / KELVIN_STEP) * KELVIN_STEP if case.has_temperature else np.nan
    return Capture(samples[begin:end], soc[begin:end], cell_file(case).pack(cells, 1))


def cell_file(case: Case) -> CellModel:
    """Return the cell file of the estimator."""
    kind = "nmc" if case.truth.ocv_v is OXIDE.ocv_v else "lfp"
    generic = load_cell(kind, case.file_capacity_ratio * case.truth.capacity_ah)
    if case.file_temperatures_c == "generic":
        return generic
    rng = np.random.default_rng(2000 + case.seed)
    return own_file(case.truth, generic, OCV_STD_V[kind], case.file_temperatures_c, rng, case.file_ocv_error_ratio)


def own_file(
    truth: Truth,
    generic: CellModel,
    ocv_std_v: float,
    temperatures_c: tuple[float, ...],
    rng: np.random.Generator,
    ocv_error_ratio: float = 1.0,
) -> CellModel:
    """Return a cell file of another cell of the same type, with the capacity of ``generic``.

    Args:
        truth: True cell.
        generic: Generic cell file of its chemistry.
        ocv_std_v: Std of the voltage error of the OCV [V].
        temperatures_c: Temperatures at which the resistances were measured [C].
        rng: Generator of the errors.
        ocv_error_ratio: Error of the OCV divided by a typical error.
    """
    slope_v = np.gradient(truth.ocv_v, GRID)
    std_v, std_soc_v = ocv_error_ratio * ocv_std_v, ocv_error_ratio * OCV_STD_SOC * slope_v
    ocv_error_v = std_v * smooth(rng, OCV_LENGTH_SOC) + std_soc_v * smooth(rng, OCV_LENGTH_SOC)
    file_ocv_v = rising((truth.ocv_v + ocv_error_v)[OCV_NODES])
    hysteresis_v = truth.hysteresis_v[GRID.size // 2]  # constant over SOC; this error is within ``error_v``
    table = {
        "soc": GRID[OCV_NODES],
        "ocv_v": file_ocv_v + 1e-6 * np.arange(OCV_NODES.size),
        "error_v": np.hypot(np.hypot(std_v, std_soc_v)[OCV_NODES], RESTED_FRACTION_STD * hysteresis_v),
        "hysteresis_v": np.full(OCV_NODES.size, hysteresis_v),
    }
    ocv = TableOcv(form="table", **{name: tuple(column) for name, column in table.items()})
    return generic.model_copy(update={"ocv": ocv, "ladder": ladder(truth, temperatures_c, rng)})


def rising(curve_v: Floats) -> Floats:
    """Return the curve with its falling parts made constant.

    It is corrected from the middle outwards, so that an error at an end does not spread over the whole curve.
    """
    half = curve_v.size // 2
    return np.r_[np.minimum.accumulate(curve_v[half - 1 :: -1])[::-1], np.maximum.accumulate(curve_v[half:])]


def ladder(truth: Truth, temperatures_c: tuple[float, ...], rng: np.random.Generator) -> Ladder:
    """Return the RC ladder of another cell of the same type.

    The ladder is fitted to the true impedance at each SOC by relative non-negative least squares. Then its resistances are
    multiplied by random factors, because the cell file comes from another cell.
    """
    # columns: impedance per ohm of R_s and of each RC pair, at each frequency
    unit_impedances = 1.0 / (1.0 + 1j * RAD_S[:, None] * np.array([0.0, *TAU_S]))
    common_factor = np.exp(R_STD * rng.standard_normal())
    weak_ohm, strong_ohm = [], []
    for node in NODES:
        rows, normalized_impedances = [], []
        for t in temperatures_c:
            true_impedance = impedance(truth, node, t, RAD_S, STEADY_C * truth.capacity_ah)
            parts = [
                arrhenius(energy_j, t) * unit_impedances for energy_j in (LOW_ACTIVATION_ENERGY, HIGH_ACTIVATION_ENERGY)
            ]
            rows.append(
                (unit_impedances if len(temperatures_c) == 1 else np.hstack(parts)) / np.abs(true_impedance)[:, None]
            )
            normalized_impedances.append(true_impedance / np.abs(true_impedance))
        matrix, target = np.concatenate(rows), np.concatenate(normalized_impedances)
        ohm, _ = nnls(np.concatenate([matrix.real, matrix.imag]), np.concatenate([target.real, target.imag]))
        if len(temperatures_c) == 1:
            ohm = np.concatenate([WEAK_SHARE * ohm, (1.0 - WEAK_SHARE) * ohm])
        weak, strong = ohm.reshape(2, -1) * common_factor * np.exp(SHAPE_STD * rng.standard_normal(1 + len(TAU_S)))
        weak_ohm.append(weak)
        strong_ohm.append(strong)
    return Ladder(
        soc=tuple(GRID[NODES]),
        weak_ohm=tuple(map(tuple, np.transpose(weak_ohm))),
        strong_ohm=tuple(map(tuple, np.transpose(strong_ohm))),
        std=R_STD,
        error_v=0.005,
        temperature_c=(min(temperatures_c), max(temperatures_c)),
    )
