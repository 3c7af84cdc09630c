"""Lower bound of the std of the SOC: its documented table, its limits, and a simulation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.kernels.kalman_filter.anchors import FULL
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.pack_model.accuracy import Accuracy, Window, improvements, window_of_history, with_soc_bound
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.prior import DIRECTION_CORRELATION_SOC, curve_covariance
from bms_estimator.pack_model.unknowns import DIRECTIONS
from tests.pack_model.quick_fit import quick_fit

PAGE = Path(__file__).parents[2] / "docs" / "theory" / "observability.md"
CELLS = ("nmc", "nca", "lmo", "lfp", "ncr18650")
"""Generic cells, and the file of one measured cell."""
LOWEST_SOCS = (0.12, 0.30, 0.50)
"""Lower ends of the windows; the documented table has the first and the last [SOC]."""
SOCS = np.array([0.2, 0.35, 0.5, 0.65, 0.8, 0.9])
"""SOCs of the columns of the documented table."""
RATED_AH = 3.0
"""Capacity of the cells [Ah]. No result depends on it."""
TOLERANCE = 0.11
"""Tolerance of a documented std, which is rounded to 0.1 [%]."""
SMOOTH_SOC = 0.03
"""Std of the Gaussian kernel that smooths the simulated curves. Curves of real cells have no steps [SOC]."""


def curves(name: str) -> CellCurves:
    """Return the curves of a cell."""
    return CellCurves(Estimator(load_cell(name, RATED_AH)).cell_file_settings)


def documented() -> dict[tuple[str, float, bool], list[str]]:
    """Return the stds of the documented table by cell, lowest SOC and full charge. A table cell has two: without and with full charges."""
    lines = [line.strip("| ").split(" | ") for line in PAGE.read_text(encoding="utf-8").splitlines()]
    rows = [line for line in lines if line[0].startswith("`") and "/" in line[-1]]
    return {
        (row[0].strip("`"), float(row[1]), full): [
            value if value == "-" else value.split("/")[full] for value in row[2:]
        ]
        for row in rows
        for full in (False, True)
    }


@pytest.mark.parametrize("name", ["nmc", "lfp", "ncr18650"])
def test_the_documented_table_has_the_computed_values(name: str) -> None:
    rows, cell = documented(), curves(name)
    for low in (min(LOWEST_SOCS), max(LOWEST_SOCS)):
        for full in (False, True):
            result, expected = Accuracy(cell, Window(low, full=full)), rows[name, low, full]
            stds = [*result.std(SOCS), result.mean_std, result.capacity_std]
            is_inside = [*(low <= SOCS), True, True]
            assert [v != "-" for v in expected] == is_inside
            numbers = [(100.0 * std, float(e)) for std, e in zip(stds, expected, strict=True) if e != "-"]
            assert all(abs(value - number) < TOLERANCE for value, number in numbers)


@pytest.mark.parametrize("name", CELLS)
def test_a_full_charge_lowers_the_std_and_a_narrow_window_raises_it(name: str) -> None:
    cell, at = curves(name), np.array([0.65])
    stds = [Accuracy(cell, Window(low)).std(at)[0] for low in LOWEST_SOCS]
    assert stds == sorted(stds)
    assert stds[0] < stds[-1]
    for low in LOWEST_SOCS:
        assert Accuracy(cell, Window(low, full=True)).mean_std < 0.9 * Accuracy(cell, Window(low)).mean_std


def test_an_unseen_charge_raises_the_std_and_a_measured_capacity_lowers_it() -> None:
    cell = curves("lfp")
    usual, unseen, measured = (
        Accuracy(cell, window).mean_std
        for window in (Window(0.12), Window(0.12, charge_seen=False), Window(0.12, capacity_std=0.01))
    )
    assert measured < 0.9 * usual < 0.9 * unseen


def test_the_voltages_cannot_separate_soc_and_capacity_from_the_curve() -> None:
    """A shift and a stretch of the SOC with the curve leave the voltages as they are."""
    assert (Accuracy(curves("nca"), Window(0.12)).spectrum[0] < 1e-6).sum() == 2


def test_each_change_lowers_the_std_of_an_lfp_pack_that_is_never_full() -> None:
    cell, window = curves("lfp"), Window(0.2, 0.9, has_temperature=False)
    stds, present = improvements(cell, window), Accuracy(cell, window).mean_std
    assert [*stds] == ["a full charge each week", "a measured OCV curve", "discharges to 10%", "a temperature sensor"]
    assert list(stds.values()) == sorted(stds.values())
    assert max(stds.values()) < present


@pytest.mark.parametrize(
    ("name", "low", "best"), [("lfp", 0.2, "a full charge each week"), ("nmc", 0.2, "a measured OCV curve")]
)
def test_a_change_that_costs_nothing_is_first_only_if_it_helps_about_as_much(name: str, low: float, best: str) -> None:
    stds = improvements(curves(name), Window(low, 0.8))
    assert next(iter(stds)) == best
    assert min(stds, key=lambda change: stds[change]) == "a measured OCV curve"


def test_a_fit_carries_the_bound_and_the_best_change_of_the_use_since_the_last_exchange() -> None:
    cell, rows = curves("lfp"), np.zeros(40, HISTORY_ROW)
    rows["segment"], rows["soc"], rows["current_a"] = np.arange(40) // 20, np.linspace(0.5, 0.9, 40), 1.0
    rows["reference_kind"][0], rows["current_a"][-1] = FULL, -1.0
    assert window_of_history(rows, None, has_temperature=True) == Window(0.5, 0.9, full=True)
    fitted = replace(quick_fit(cell, rows[20:]), first_segment=1.0)
    window = window_of_history(rows, fitted, has_temperature=False)
    assert window == Window(rows["soc"][20], 0.9, full=False, has_temperature=False)
    bound, stds = with_soc_bound(fitted, cell, rows, has_temperature=False).soc_bound, improvements(cell, window)
    assert bound
    assert (bound.std, bound.change, bound.changed_std) == (
        Accuracy(cell, window).mean_std,
        *min(stds.items(), key=lambda s: s[1]),
    )
    assert with_soc_bound(quick_fit(cell, rows[:2]), cell, rows[:2], has_temperature=True).soc_bound is None


def test_changes_in_force_are_not_proposed() -> None:
    assert [*improvements(curves("ncr18650"), Window(0.05, full=True))] == []


@pytest.mark.parametrize(("name", "tolerance"), [("ncr18650", 0.1), ("nmc", 0.2)])
def test_the_error_in_a_simulation_agrees_with_the_std(name: str, tolerance: float) -> None:
    window = Window(0.30)
    rms_std = np.sqrt(np.mean(Accuracy(curves(name), window).std(window.soc) ** 2))
    errors = errors_of_draws(name, window, 200)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(rms_std, rel=tolerance)
    assert np.mean(np.abs(errors) < 2.0 * rms_std) > 0.9


def errors_of_draws(name: str, window: Window, draws: int) -> Floats:
    """Return the error of the SOC at each SOC of the window, shape (draws, n).

    The voltages are those of a random curve. The least-squares estimate starts at the true SOC and is linearized again at
    each iteration. The hysteresis is known.
    """
    rng, cell, soc = np.random.default_rng(1), curves(name), window.soc
    grid = np.linspace(0.0, 1.0, 101)
    root = np.linalg.cholesky(curve_covariance(cell, grid) + 1e-10 * np.eye(grid.size))
    kernel = np.exp(-0.5 * ((grid[:, None] - grid) / SMOOTH_SOC) ** 2)
    smooth = kernel @ root
    smooth *= (np.linalg.norm(root, axis=1) / np.linalg.norm(smooth, axis=1))[:, None]
    by_direction = (
        np.exp(-np.abs(soc[:, None] - soc) / DIRECTION_CORRELATION_SOC) * cell.direction_std_v**2 / DIRECTIONS
    )
    precision = np.linalg.inv(curve_covariance(cell, soc) + by_direction)
    from_middle = soc - 0.5 * (soc[0] + soc[-1])
    results = []
    for _ in range(draws):
        curve_v = np.interp(soc, grid, smooth @ rng.standard_normal(grid.size))
        noise_v = np.linalg.cholesky(by_direction) @ rng.standard_normal(soc.size)
        declared = cell.capacity_std * rng.standard_normal()
        shift, stretch = 0.0, declared
        for _ in range(30):
            at = soc + shift + stretch * from_middle
            jacobian = cell.slope(at)[:, None] * np.column_stack([np.ones(soc.size), from_middle])
            gain = jacobian.T @ precision
            normal = gain @ jacobian
            normal[1, 1] += cell.capacity_std**-2
            right = gain @ (cell.ocv(soc) + curve_v + noise_v - cell.ocv(at))
            right[1] += (declared - stretch) / cell.capacity_std**2
            step = np.linalg.solve(normal, right)
            shift, stretch = shift + step[0], stretch + step[1]
        results.append(shift + stretch * from_middle)
    return np.array(results)
