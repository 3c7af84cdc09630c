"""Captures, simulated cells and a loop for the identifier's tests."""

import csv
import gzip
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numba import njit

from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels.cell import c_tl, c_ts, emf, r_s, r_tl, r_ts, simulate_cell
from bms_estimator.kernels.identifier import identifier_init, identifier_step
from bms_estimator.kernels.identifier_state import IDENTIFIER_STATE, Tuning, identifier_settings
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.suspect import Suspect

TRACE = np.dtype(
    [
        ("soc", "f8"),
        ("soc_std", "f8"),
        ("innovation_v", "f8"),
        ("nis", "f8"),
        ("misfit", "f8"),
        ("suspects", "i8"),
        ("ln", "f8", 5),
        ("ln_std", "f8", 5),
    ]
)
LN_NAMES = ("R_s", "R_ts", "tau_ts", "R_tl", "tau_tl")
SENSOR = {"noise_v": 0.0005, "resolution_v": 0.001}
"""Of the captures: about that of the instrument."""
PROTOCOL_CAPACITY_AH = 3.0
"""True SOC of a capture is its initial SOC less Ah over this."""
ROUND_SOC = {
    "cell1_hppc": 1.0,
    "cell5_hppc": 0.98,
    "cell1_random_steps": 0.98,
    "cell5_random_steps": 1.0,
    "cell1_dst": 1.0,
    "cell5_relaxation_c2": 1.0,
}
"""At the first sample, known to half a percent: 0.98 where the first rest lies at 4.13 V, else full."""
INITIAL_SOC = {
    "cell1_hppc": 1.0014,
    "cell5_hppc": 0.9834,
    "cell1_random_steps": 0.9784,
    "cell5_random_steps": 0.9994,
    "cell1_dst": 1.0014,
    "cell5_relaxation_c2": 1.0014,
    "cell1_discharge_c20": 1.0,
    "cell1_discharge_c4": 1.0,
    "cell1_discharge_1c5": 1.0,
    "cell1_charge_c20": 0.0,
}
"""What aligns the rests of all captures of a cell on the shipped curve."""


@dataclass(frozen=True)
class Run:
    """Input, truth and what the identifier made of it; all arrays of shape (n,)."""

    time_s: np.ndarray
    current_a: np.ndarray
    soc: np.ndarray
    trace: np.ndarray
    state: np.ndarray

    def after(self, start_s: float, least_soc: float = 0.05) -> np.ndarray:
        """Which samples are judged."""
        return (self.time_s >= self.time_s[0] + start_s) & (self.soc >= least_soc)

    @property
    def error(self) -> np.ndarray:
        """Error of the published SOC, 0..1."""
        return np.clip(self.trace["soc"], 0.0, 1.0) - self.soc

    def soc_rms_percent(self, start_s: float) -> float:
        return 100.0 * rms(self.error[self.after(start_s)])

    def coverage(self) -> float:
        """Share of samples whose true SOC is inside the 2-sigma band."""
        return float(np.mean(np.abs(self.error) <= 2.0 * self.trace["soc_std"]))

    def element_errors(self, model: CellModel, samples: np.ndarray) -> np.ndarray:
        """ln(estimated / true) of R_s, R_ts, tau_ts, R_tl, tau_tl at ``samples``; shape (n, 5)."""
        true = np.array([elements(model, z) for z in self.soc[samples]])
        return self.trace["ln"][samples] - np.log(true)

    def suspected(self) -> Suspect:
        """All that was suspected at any time."""
        return Suspect(int(np.bitwise_or.reduce(self.trace["suspects"])))

    def innovation_rms_mv(self, start_s: float) -> float:
        return 1e3 * rms(self.trace["innovation_v"][self.after(start_s)])


def rms(x: np.ndarray) -> float:
    return math.sqrt(float(np.mean(np.square(x))))


@njit
def loop(state, settings, time_s, current_a, voltage_v, trace):
    """Every sample in turn; what was known after it goes to ``trace``."""
    s, p = state[0], settings[0]
    last = time_s[0]
    for j in range(len(time_s)):
        identifier_step(s, p, time_s[j] - last, current_a[j], voltage_v[j])
        last = time_s[j]
        row = trace[j]
        row.soc = s.mean[0]
        row.soc_std = math.sqrt(s.covariance[0, 0])
        row.innovation_v = s.innovation_v
        row.nis = s.innovation_v**2 / s.innovation_variance if s.innovation_variance > 0.0 else np.nan
        row.misfit = s.misfit
        row.suspects = s.suspects
        for k in range(5):
            row.ln[k] = s.mean[3 + k]
            row.ln_std[k] = math.sqrt(s.covariance[3 + k, 3 + k])


@njit
def fast(state, settings, dt_s, current_a, voltage_v):
    """Samples at an even step, without a trace."""
    for j in range(len(current_a)):
        identifier_step(state[0], settings[0], dt_s, current_a[j], voltage_v[j])


@cache
def cell(name: str) -> CellModel:
    return load_cell(name)


def elements(model: CellModel, soc: float) -> np.ndarray:
    """R_s, R_ts, tau_ts, R_tl, tau_tl of the model at ``soc``."""
    a = model.a
    return np.array([r_s(soc, a), r_ts(soc, a), r_ts(soc, a) * c_ts(soc, a), r_tl(soc, a), r_tl(soc, a) * c_tl(soc, a)])


def settings(
    model: CellModel,
    soc: float,
    factors=(1.0,) * 5,
    *,
    capacity_ah: float | None = None,
    ocv: CellModel | None = None,
    noise_v: float = SENSOR["noise_v"],
    resolution_v: float = SENSOR["resolution_v"],
    tuning: Tuning | None = None,
) -> np.ndarray:
    """The identifier's settings for a cell, its elements at SOC 0.5 times ``factors``."""
    return identifier_settings(
        capacity_ah or model.cell.capacity_ah,
        *ocv_grid(ocv or model),
        soc,
        tuple(elements(model, 0.5) * factors),
        noise_v=noise_v,
        resolution_v=resolution_v,
        tuning=tuning,
    )


def new_state(p: np.ndarray) -> np.ndarray:
    state = np.zeros(1, dtype=IDENTIFIER_STATE)
    identifier_init(state[0], p[0])
    return state


def identify(p, time_s, current_a, voltage_v, soc, state=None) -> Run:
    """Run the identifier over a record."""
    state = new_state(p) if state is None else state
    trace = np.zeros(len(time_s), dtype=TRACE)
    columns = [np.ascontiguousarray(x, dtype=np.float64) for x in (time_s, current_a, voltage_v)]
    loop(state, p, *columns, trace)
    return Run(columns[0], columns[1], soc, trace, state)


@cache
def capture(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], current [A], voltage [V], true SOC of a capture, without its glitches in voltage."""
    with gzip.open(folder / "ncr18650" / f"{name}.csv.gz", "rt") as file:
        rows = [[float(x) for x in row[:3]] for row in list(csv.reader(file))[1:]]
    time_s, current_a, voltage_v = (x[np.newaxis] for x in np.array(rows).T)
    time_s, current_a, voltage_v = np.concatenate([time_s, current_a, voltage_v])[
        :, (voltage_v[0] > 2.0) & (voltage_v[0] < 4.4)
    ]
    step_s = np.clip(np.diff(time_s), 0.0, None)
    moved_ah = np.concatenate([[0.0], np.cumsum(current_a[:-1] * step_s)]) / 3600.0
    return time_s, current_a, voltage_v, INITIAL_SOC[name] - moved_ah / PROTOCOL_CAPACITY_AH


def identify_capture(folder: Path, name: str, factors=(1.0,) * 5, wrong_soc: float = -0.2, **kwargs) -> Run:
    """The identifier on a real capture, started at a wrong SOC with wrong elements."""
    time_s, current_a, voltage_v, soc = capture(folder, name)
    p = settings(cell("ncr18650"), min(soc[0] + wrong_soc, 1.0), factors, **kwargs)
    return identify(p, time_s, current_a, voltage_v, soc)


@dataclass(frozen=True)
class Simulated:
    """A simulated cell under load, seen through a converter."""

    time_s: np.ndarray
    current_a: np.ndarray
    voltage_v: np.ndarray
    soc: np.ndarray
    noise_v: float
    resolution_v: float


def pulses(
    hours: float, rate_hz: float, amplitude_a: float, *, both_ways: bool = False, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Five minutes of steps of random height 0..2 ``amplitude_a``, ten minutes of rest, over again."""
    time_s = np.arange(round(hours * 3600 * rate_hz)) / rate_hz
    height = amplitude_a * np.random.default_rng(seed).uniform(0.0, 2.0, int(time_s[-1] // 60) + 1)
    on = (time_s % 900.0 < 300.0) & (time_s >= 10.0)
    way = np.where(time_s // 900.0 % 2.0 == 1.0, -1.0, 1.0) if both_ways else 1.0
    return time_s, np.where(on, way * height[(time_s // 60.0).astype(int)], 0.0)


def convert(
    voltage_v: np.ndarray, bits: int, full_scale_v: float, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """A converter's view: half a step of noise, rounding. Also its step [V]."""
    step_v = full_scale_v / 2**bits
    return step_v * np.round(voltage_v / step_v + 0.5 * rng.standard_normal(len(voltage_v))), step_v


@njit
def simulate_ageing(time_s, current_a, capacity_as, soc, x, growth):
    """Drop over R_s and branches [V] and SOC of constant elements ``x`` whose resistances grow by ``growth`` in all."""
    n = len(time_s)
    drop_v, truth = np.empty(n), np.empty(n)
    v_ts = v_tl = 0.0
    for j in range(n):
        grown = 1.0 + growth * time_s[j] / time_s[-1]
        if j > 0:
            step_s, i = time_s[j] - time_s[j - 1], current_a[j - 1]
            soc -= i * step_s / capacity_as
            e_ts, e_tl = math.exp(-step_s / x[2]), math.exp(-step_s / x[4])
            v_ts = e_ts * v_ts + (1.0 - e_ts) * x[1] * grown * i
            v_tl = e_tl * v_tl + (1.0 - e_tl) * x[3] * grown * i
        drop_v[j] = v_ts + v_tl + x[0] * grown * current_a[j]
        truth[j] = soc
    return drop_v, truth


def simulate(
    model: CellModel, time_s: np.ndarray, current_a: np.ndarray, *, bits: int = 16, soc: float = 1.0, seed: int = 0
) -> Simulated:
    """Terminal voltage of a cell with (2.5)-(2.10), or its table OCV, through a converter of 5 V."""
    a = model.a.copy()
    table = bool(np.isnan(a[16]))
    if table:
        a[16:] = cell("chen_mora").a[16:]
    capacity_as = model.cell.capacity_ah * 3600.0
    voltage_v, truth = simulate_cell((soc, 0.0, 0.0), time_s, current_a, capacity_as, a)
    if table:
        voltage_v += ocv(model, truth) - np.array([emf(z, a) for z in truth])
    seen_v, step_v = convert(voltage_v, bits, 5.0, np.random.default_rng(seed))
    return Simulated(time_s, current_a, seen_v, truth, 0.5 * step_v, step_v)


def ocv(model: CellModel, soc: np.ndarray) -> np.ndarray:
    """E_o of the grid that the identifier uses [V]."""
    grid_v, _ = ocv_grid(model)
    return np.interp(soc, np.linspace(0.0, 1.0, len(grid_v)), grid_v)


def identify_simulated(model: CellModel, x: Simulated, factors=(1.0,) * 5, wrong_soc: float = -0.2, **kwargs) -> Run:
    """The identifier on a simulated cell."""
    p = settings(model, x.soc[0] + wrong_soc, factors, noise_v=x.noise_v, resolution_v=x.resolution_v, **kwargs)
    return identify(p, x.time_s, x.current_a, x.voltage_v, x.soc)
