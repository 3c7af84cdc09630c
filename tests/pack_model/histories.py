"""Histories without noise. The model of the slow fit computes their voltages for given true values."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import HISTORY_ROW, HYSTERESIS_SOC, ROW_SOC
from bms_estimator.kernels.cell_model.rc_ladder import TAUS
from bms_estimator.model.cell import load_cell
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.equations import Equations
from bms_estimator.pack_model.prediction import Reference
from bms_estimator.pack_model.unknowns import SCALES, Unknowns
from bms_estimator.settings.observer import EXACT, Sampling

CAPACITY_AH = 3.0
REST_ROWS_S = (60.0, 120.0, 600.0, 1800.0, 3600.0)
"""Durations of the rows of one rest [s]."""
DAY = ((0.30, 0.35), (0.0, 0.0), (0.5, 0.3), (0.0, 0.0), (-0.25, 0.65), (0.0, 0.0))
"""Phases of a day: current as a C-rate, positive on discharge, and charge [SOC]. A charge of 0 is a rest."""


@dataclass(frozen=True)
class Truth:
    """True values, constant over the history."""

    soc: float = 0.9
    """SOC at the first row."""
    ln_q: float = 0.0
    """ln of the true over the declared capacity."""
    offset_c: float = 0.0
    """Offset of the current sensor, as a C-rate."""
    ln_r: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """ln of the true over the file's resistances of each group."""


def cell_curves(chemistry: str = "nmc", sampling: Sampling = EXACT) -> CellCurves:
    """Return the curves of a generic cell."""
    estimator = Estimator(load_cell(chemistry, CAPACITY_AH), sampling=sampling)
    return CellCurves(estimator.settings_record[0]["filter"])


def phases(days: int) -> list[tuple[float, float]]:
    """Return current [C-rate] and duration [s] of each row."""
    rows: list[tuple[float, float]] = []
    for _ in range(days):
        for rate_c, soc in DAY:
            if rate_c == 0.0:
                rows += [(0.0, duration_s) for duration_s in REST_ROWS_S]
            else:
                count = round(soc / ROW_SOC)
                rows += [(rate_c, soc / count / abs(rate_c) * 3600.0)] * count
    return rows


def measured_rows(cell: CellCurves, days: int = 3, *, segment: int = 0, gap_s: float = np.inf) -> np.ndarray:
    """Return rows of one segment with all fields but voltage and SOC, which ``with_voltages`` sets."""
    profile = phases(days)
    rows = np.zeros(len(profile), HISTORY_ROW)
    time_s, charge_as, throughput_soc = 0.0, 0.0, 0.0
    x_a, hysteresis = np.zeros(TAUS.size), np.zeros(2)
    for row, (rate_c, duration_s) in zip(rows, profile, strict=True):
        current_a = rate_c * cell.one_c_a
        moved_soc = rate_c * duration_s / 3600.0
        # a row has the values in its middle, therefore the state advances by two halves of the row
        x_a = filtered_currents(x_a, current_a, duration_s / 2)
        hysteresis = moved_hysteresis(hysteresis, moved_soc / 2)
        row["elapsed_s"], row["duration_s"], row["settled_s"] = time_s + duration_s / 2, duration_s, time_s
        row["direction"], row["current_a"], row["x_a"] = np.sign(rate_c), current_a, x_a
        row["charge_as"] = charge_as + current_a * duration_s / 2
        row["throughput_soc"], row["hysteresis"] = throughput_soc + abs(moved_soc) / 2, hysteresis
        row["temperature_c"] = 22.0 + 6.0 * np.sin(time_s / 20000.0)
        x_a = filtered_currents(x_a, current_a, duration_s / 2)
        hysteresis = moved_hysteresis(hysteresis, moved_soc / 2)
        time_s, charge_as = time_s + duration_s, charge_as + current_a * duration_s
        throughput_soc += abs(moved_soc)
    rows["segment"], rows["gap_s"] = segment, gap_s
    rows["reference_soc"] = rows["reference_std"] = np.nan
    return rows


def filtered_currents(x_a: np.ndarray, current_a: float, time_s: float) -> np.ndarray:
    """Return the filtered currents of the RC pairs after ``time_s`` of a constant current [A]."""
    return current_a + (x_a - current_a) * np.exp(-time_s / TAUS)


def moved_hysteresis(hysteresis: np.ndarray, moved_soc: float) -> np.ndarray:
    """Return both parts of the hysteresis after a discharge (positive) or charge of ``moved_soc``."""
    if moved_soc == 0.0:
        return hysteresis
    target = -np.sign(moved_soc)
    return target + (hysteresis - target) * np.exp(-abs(moved_soc) / np.array(HYSTERESIS_SOC))


def equations_of(cell: CellCurves, rows: np.ndarray) -> Equations:
    """Return the equations, with the std of each row at its own SOC and at the file's resistances."""
    return Equations(cell, rows, Reference(rows["soc"], np.zeros(SCALES)))


def unknowns_of(equations: Equations, truth: Truth) -> np.ndarray:
    """Return the vector of unknowns of a history of one segment."""
    x, u, links = equations.prior.mean.copy(), equations.unknowns, equations.links
    x[u.ln_q], x[u.offset], x[u.ln_r] = truth.ln_q, truth.offset_c, truth.ln_r
    x[u.soc] = truth.soc
    for k, drawn_soc, hours in zip(links.interval, links.drawn_soc, links.hours, strict=True):
        x[u.soc.start + k] = x[u.soc.start + k - 1] - (drawn_soc - truth.offset_c * hours) * np.exp(-truth.ln_q)
    return x


def with_voltages(cell: CellCurves, rows: np.ndarray, truth: Truth, filter_error: float = 0.0) -> np.ndarray:
    """Return the rows of one segment with the voltages of the true cell and the SOC of a filter.

    Args:
        cell: Curves of the cell file.
        rows: Rows; the first is at the true start SOC.
        truth: True values.
        filter_error: Error of the filter's SOC.
    """
    rows = rows.copy()
    equations = equations_of(cell, rows)
    prediction = equations.model.predict(unknowns_of(equations, truth))
    rows["voltage_v"], rows["soc"] = prediction.voltage_v * cell.series, prediction.soc + filter_error
    return rows


def reference_row(rows: np.ndarray, soc: float, std: float) -> np.ndarray:
    """Return a row of a known SOC at the end of the last of ``rows``, of shape (1,)."""
    row = rows[-1:].copy()
    row["elapsed_s"] += row["duration_s"] / 2
    row["charge_as"] += row["current_a"] * row["duration_s"] / 2
    for name in ("duration_s", "voltage_v", "current_a", "temperature_c", "settled_s", "x_a"):
        row[name] = 0.0
    row["soc"], row["reference_soc"], row["reference_std"] = soc, soc, std
    return row


def random_unknowns(equations: Equations, seed: int = 1) -> np.ndarray:
    """Return plausible unknowns: the SOCs of a true history, with random values of all other unknowns."""
    rng, u = np.random.default_rng(seed), equations.unknowns
    x = unknowns_of(equations, Truth(ln_q=0.05, offset_c=0.002, ln_r=(0.2, -0.1, 0.3)))
    for part, std in spreads(u):
        x[part] += rng.normal(0.0, std, x[part].size)
    return x


def spreads(u: Unknowns) -> tuple[tuple[slice, float], ...]:
    """Return the std of the random values of the unknowns."""
    return (
        (u.shape, 0.1),
        (u.aging, 0.5),
        (u.hysteresis, 0.2),
        (u.start_hysteresis, 0.3),
        (u.start_load, 0.5),
        (u.entropy, 1e-4),
        (u.arrhenius, 3e-3),
        (u.full, 5e-3),
        (u.curve, 2e-3),
        (u.direction, 0.1),
    )
