"""Fits of histories with known true values, and of unusual histories."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st
from threadpoolctl import threadpool_info, threadpool_limits

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.cell import load_cell
from bms_estimator.model.input_faults import InputFault
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import LN_Q, LN_R, OFFSET, SOC, STARTS, FitError, PackFit, fit, starts
from tests.pack_model.histories import (
    CAPACITY_AH,
    Truth,
    cell_curves,
    equations_of,
    measured_rows,
    reference_row,
    unknowns_of,
    with_voltages,
)

CHARGED_SOC = 0.5
"""Charge that a gap hides."""
FILTER_ERROR = 0.06
"""Error of the filter's SOC, at which a fit starts."""


def std_of(fitted: PackFit) -> np.ndarray:
    return np.sqrt(np.diag(fitted.covariance))


@pytest.mark.parametrize(
    "truth",
    [
        Truth(soc=0.9),
        Truth(soc=0.86, ln_q=-0.06, offset_c=0.0008, ln_r=(0.4, 0.3, 0.25)),
        Truth(soc=0.97, ln_q=0.05, offset_c=-0.0005, ln_r=(-0.3, -0.3, -0.2)),
    ],
)
def test_rows_without_noise_are_fitted_back(truth: Truth) -> None:
    """The fit starts at the filter's SOC, which is wrong. Two known SOCs make the capacity observable."""
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell, days=5), truth, filter_error=FILTER_ERROR)
    lowest = int(np.argmin(rows["soc"]))
    parts = [rows[: lowest + 1], rows[lowest + 1 :]]
    known = [reference_row(part, end_soc(cell, part, truth), 0.005) for part in parts]
    fitted = fit(cell, np.concatenate([parts[0], known[0], parts[1], known[1]]))
    std = std_of(fitted)
    assert abs(fitted.mean[SOC] - known[1]["reference_soc"][0]) < 0.003
    assert abs(fitted.mean[LN_Q] - truth.ln_q) < 0.01
    assert std[LN_Q] < 0.5 * cell.capacity_std
    assert abs(fitted.mean[OFFSET] - truth.offset_c) < 0.5 * std[OFFSET]
    np.testing.assert_allclose(fitted.mean[LN_R], truth.ln_r, atol=0.08)
    assert not fitted.faults


@pytest.mark.parametrize(
    ("chemistry", "columns", "middle", "ratio", "fault"),
    [
        ("nmc", ["current_a", "x_a"], 0.0, 0.05, InputFault.FITTED_RESISTANCE),
        ("nmc", ["temperature_c"], REFERENCE_C, -0.6, InputFault.FITTED_TEMPERATURE),
        ("lfp", ["voltage_v"], 0.0, 1.03, InputFault.FITTED_CURVE),
    ],
)
def test_a_fitted_value_far_from_its_prior_is_a_fault(
    chemistry: str, columns: list[str], middle: float, ratio: float, fault: InputFault
) -> None:
    """The measured values have a wrong gain about ``middle``."""
    cell = cell_curves(chemistry)
    rows = with_voltages(cell, measured_rows(cell), Truth())
    for name in columns:
        rows[name] = middle + (rows[name] - middle) * ratio
    assert fit(cell, rows).faults == fault


def end_soc(cell: CellCurves, rows: np.ndarray, truth: Truth) -> float:
    """Return the true SOC at the end of the last row. The row's SOC is the filter's one in the middle of the row."""
    last = rows[-1]
    drawn_soc = (last["current_a"] / cell.one_c_a - truth.offset_c) * last["duration_s"] / 7200.0
    return float(last["soc"] - FILTER_ERROR - drawn_soc * np.exp(-truth.ln_q))


def test_resistances_that_rise_more_near_empty_do_not_move_the_soc() -> None:
    """At SOC 0 the resistances are twice those of the file. Without ``EMPTY_SHAPE_STD`` the RMSE is 3.1 %."""
    cell, truth = cell_curves("nca"), Truth(soc=0.72)
    rows = with_voltages(cell, measured_rows(cell, days=2), truth)
    equations = equations_of(cell, rows)
    x = unknowns_of(equations, truth)
    x[equations.unknowns.shape.start] = np.log(2.0)
    rows["voltage_v"] = equations.model.predict(x).voltage_v * cell.series
    error = fit(cell, rows).row_soc - rows["soc"]
    assert np.sqrt(np.mean(error**2)) < 0.015


def test_known_soc_corrects_the_soc_and_lowers_its_std() -> None:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell, days=1), Truth())
    free = fit(cell, rows)
    known_soc = rows["soc"][-1] + 0.04
    known = fit(cell, np.concatenate([rows, reference_row(rows, known_soc, 0.005)]))
    assert abs(known.mean[SOC] - known_soc) < 0.5 * abs(free.mean[SOC] - known_soc)
    assert std_of(known)[SOC] < std_of(free)[SOC]


def with_hidden_charge(charged_soc: float) -> np.ndarray:
    """Return two segments of a cell with a gap of two hours between them, in which it was charged."""
    cell = cell_curves()
    first = with_voltages(cell, measured_rows(cell, days=1), Truth())
    first = first[: np.argmin(first["soc"]) + 1]
    start_soc = first["soc"][-1] + charged_soc
    second = measured_rows(cell, days=2, segment=1, gap_s=7200.0)
    second["elapsed_s"] += first["elapsed_s"][-1] + first["duration_s"][-1] + 7200.0
    return np.concatenate([first, with_voltages(cell, second, Truth(soc=start_soc))])


def test_charge_hidden_by_a_gap_does_not_move_the_capacity() -> None:
    rows = with_hidden_charge(CHARGED_SOC)
    fitted = fit(cell_curves(), rows)
    assert abs(fitted.mean[LN_Q]) < 0.03
    assert np.abs(fitted.row_soc - rows["soc"]).max() < 0.03


def test_fits_are_bit_identical() -> None:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell), Truth(ln_q=0.04, ln_r=(0.2, 0.2, 0.2)), 0.03)
    first = fit(cell, rows[:60])
    one, two = (fit(cell, rows.copy(), first) for _ in range(2))
    assert one.mean.tobytes() == two.mean.tobytes()
    assert one.covariance.tobytes() == two.covariance.tobytes()
    assert one.curve_v.tobytes() == two.curve_v.tobytes()


class ThreadCounter(CellCurves):
    """Curves that record the number of BLAS threads at each use of the OCV."""

    threads: set[int]

    def ocv(self, soc: np.ndarray) -> np.ndarray:
        self.threads = {*getattr(self, "threads", ()), blas_threads()}
        return super().ocv(soc)


def blas_threads() -> int:
    return max(int(each["num_threads"]) for each in threadpool_info() if each["user_api"] == "blas")


def test_a_fit_uses_one_thread_and_restores_their_number() -> None:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell, days=1), Truth())[:20]
    counter = ThreadCounter(Estimator(load_cell("nmc", CAPACITY_AH)).settings_record[0]["filter"])
    counter.threads = set()
    with threadpool_limits(2, user_api="blas"):
        fit(counter, rows)
        assert counter.threads == {1}
        assert blas_threads() == 2


def test_next_fit_starts_at_the_previous_one() -> None:
    """A second fit of the same rows, which starts at the result of the first, finds no worse minimum."""
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell), Truth(soc=0.88, ln_q=-0.05), 0.1)
    first = fit(cell, rows)
    second = fit(cell, rows, first)
    assert second.cost <= first.cost + 0.3
    assert abs(second.mean[SOC] - first.mean[SOC]) < std_of(first)[SOC]


def test_starts_beyond_the_uncertainty_of_the_previous_fit_are_left_out() -> None:
    """The first fit, the first after a long gap, and the first after the age has doubled have all starts."""
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell), Truth())
    first = fit(cell, np.concatenate([rows, reference_row(rows, end_soc(cell, rows, Truth()), 0.005)]))
    assert std_of(first)[SOC] < 0.01
    certain = len(first.curves[:2]) + sum(shift == 0.0 for shift, _ in STARTS)
    after_gap = rows.copy()
    after_gap["segment"][-20:] += 1.0
    for gap_s, expected in ((0.1 * cell.event_s, certain), (2.0 * cell.event_s, len(first.curves[:2]) + len(STARTS))):
        after_gap["gap_s"][-20:] = gap_s
        assert len(starts(equations_of(cell, after_gap), first)) == expected
    assert len(starts(equations_of(cell, rows), None)) == len(STARTS)
    assert len(starts(equations_of(cell, rows), first)) == certain
    half = replace(first, elapsed_s=0.5 * first.elapsed_s)
    assert len(starts(equations_of(cell, rows), half)) == len(first.curves[:2]) + len(STARTS)


def all_rest(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows["direction"] = 0.0
    for name in ("current_a", "x_a", "charge_as", "throughput_soc", "hysteresis"):
        rows[name] = 0.0
    return rows


def a_week_of_zeros(rows: np.ndarray) -> np.ndarray:
    rows = all_rest(rows)
    rows["elapsed_s"] *= 7.0 * 86400.0 / rows["elapsed_s"][-1]
    return rows


def without_voltages(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows["duration_s"], rows["reference_soc"], rows["reference_std"] = 0.0, 1.0, 0.01
    return rows


def single_rows(rows: np.ndarray) -> np.ndarray:
    rows = rows[:12].copy()
    rows["segment"] = np.arange(rows.size)
    rows["gap_s"] = np.where(np.arange(rows.size) % 2, 3600.0, np.inf)
    rows["charge_as"] = rows["throughput_soc"] = 0.0
    return rows


UNUSUAL = {
    "one row": lambda rows: rows[:1],
    "two rows": lambda rows: rows[:2],
    "no voltages": without_voltages,
    "all rest": all_rest,
    "a week without current": a_week_of_zeros,
    "segments of one row": single_rows,
}


@pytest.mark.parametrize("name", UNUSUAL)
@pytest.mark.parametrize("chemistry", ["nmc", pytest.param("lfp", marks=pytest.mark.thorough)])
def test_unusual_history_gives_a_finite_fit(name: str, chemistry: str) -> None:
    cell = cell_curves(chemistry)
    rows = UNUSUAL[name](with_voltages(cell, measured_rows(cell, days=1), Truth()))
    first = fit(cell, rows)
    for fitted in (first, fit(cell, rows, first)):
        assert np.isfinite(fitted.mean).all()
        assert np.all(std_of(fitted) > 0.0)
        assert np.isfinite(fitted.curve_v).all()


@settings(max_examples=4, phases=[Phase.explicit, Phase.generate])
@given(
    seed=st.integers(0, 1000),
    count=st.integers(1, 25),
    temperature_c=st.floats(-40.0, 80.0),
    error_v=st.floats(-2.0, 2.0),
    charge_scale=st.floats(-20.0, 20.0),
    filter_soc=st.floats(0.0, 1.0),
    capacity_std=st.sampled_from([0.0, 0.05, 0.5]),
    offset_std_a=st.sampled_from([0.0, 0.01, 1.0]),
    gap_s=st.sampled_from([0.0, 60.0, 1e6, np.inf]),
)
def test_any_finite_history_gives_a_finite_fit(
    seed: int,
    count: int,
    temperature_c: float,
    error_v: float,
    charge_scale: float,
    filter_soc: float,
    capacity_std: float,
    offset_std_a: float,
    gap_s: float,
) -> None:
    """Rows in random order of charge, with wrong voltages and extreme temperatures."""
    cell, rng = cell_curves(), np.random.default_rng(seed)
    cell.capacity_std, cell.offset_std_a = capacity_std, offset_std_a
    rows = with_voltages(cell_curves(), measured_rows(cell, days=1), Truth())
    rows = rows[np.sort(rng.choice(rows.size, count, replace=False))]
    rows["temperature_c"], rows["soc"], rows["gap_s"] = temperature_c, filter_soc, gap_s
    rows["voltage_v"] += error_v * rng.normal(size=count)
    rows["charge_as"] *= charge_scale
    rows["segment"] = np.cumsum(rng.random(count) < 0.2)
    fitted = fit(cell, rows)
    assert np.isfinite(fitted.mean).all()
    assert np.isfinite(fitted.covariance).all()
    assert np.all(np.linalg.eigvalsh(fitted.covariance) > -1e-9)


def test_no_rows_and_rows_that_are_not_finite_raise_an_error() -> None:
    cell = cell_curves()
    rows = with_voltages(cell, measured_rows(cell, days=1), Truth())
    with pytest.raises(FitError, match="no rows"):
        fit(cell, rows[:0])
    for name in ("voltage_v", "temperature_c", "charge_as", "current_a"):
        bad = rows.copy()
        bad[name][5] = np.nan
        with pytest.raises(FitError, match=f"row 5 of {rows.size}: {name}"):
            fit(cell, bad)
