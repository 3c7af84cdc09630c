"""Thinning of the history."""

import numpy as np
import pytest

from bms_estimator.kernels.accumulators.history import ROW_SOC
from bms_estimator.pack_model.cell_curves import SOC_GRID
from bms_estimator.pack_model.fit import CURVE, LN_Q, SOC, fit
from bms_estimator.pack_model.history import DAY_S, MAX_ROWS, MAX_SEGMENTS, MEAN_FIELDS, History, thin_old_rows
from tests.pack_model.histories import Truth, cell_curves, measured_rows, reference_row, with_voltages


@pytest.fixture(scope="module")
def rows() -> np.ndarray:
    """Ten days with noise. Each row is split in three, so that several rows share an SOC bin."""
    cell, rng = cell_curves(), np.random.default_rng(1)
    rows = with_voltages(cell, measured_rows(cell, days=10), Truth(ln_q=0.04, ln_r=(0.2, 0.2, 0.2)))
    parts = np.repeat(rows, 3)
    third = np.tile([-1.0, 0.0, 1.0], rows.size) * parts["duration_s"] / 3.0
    parts["duration_s"] /= 3.0
    parts["elapsed_s"] += third
    parts["charge_as"] += third * parts["current_a"]
    parts["voltage_v"] += rng.normal(0.0, 2e-3, parts.size)
    return parts


def is_old(rows: np.ndarray) -> np.ndarray:
    return (rows["elapsed_s"] < rows["elapsed_s"][-1] - 2.0 * DAY_S) & (rows["duration_s"] > 0.0)


def test_durations_and_weighted_means_are_preserved(rows: np.ndarray) -> None:
    few = thin_old_rows(rows, cell_curves().capacity_as)
    assert few.size < 0.6 * rows.size
    for field in MEAN_FIELDS:
        before = np.tensordot(rows["duration_s"], rows[field], 1)
        np.testing.assert_allclose(np.tensordot(few["duration_s"], few[field], 1), before, rtol=1e-9, atol=1e-9)
    assert few["duration_s"].sum() == pytest.approx(rows["duration_s"].sum())


def test_last_two_days_and_known_socs_are_unchanged(rows: np.ndarray) -> None:
    known = reference_row(rows[:200], 0.8, 0.01)
    few = thin_old_rows(np.concatenate([rows[:200], known, rows[200:]]), cell_curves().capacity_as)
    recent = rows[~is_old(rows)]
    assert few[-recent.size :].tobytes() == recent.tobytes()
    assert few[few["duration_s"] == 0.0].tobytes() == known.tobytes()


def test_merged_rows_have_one_segment_day_bin_and_direction(rows: np.ndarray) -> None:
    rows = rows.copy()
    rows["segment"][rows.size // 3 :] = 1
    capacity_as = cell_curves().capacity_as
    few = thin_old_rows(rows, capacity_as)
    assert np.all(np.diff(few["segment"]) >= 0.0)
    assert np.all((np.diff(few["elapsed_s"]) > 0.0) | (np.diff(few["segment"]) > 0.0))
    old = few[is_old(few)]
    key = [
        old["segment"],
        old["elapsed_s"] // DAY_S,
        np.floor(old["charge_as"] / (ROW_SOC * capacity_as)),
        old["direction"],
    ]
    assert np.unique(np.column_stack(key), axis=0).shape[0] == old.size
    assert set(np.unique(few["direction"])) == {-1.0, 0.0, 1.0}


def test_number_of_rows_is_bounded(rows: np.ndarray) -> None:
    """The newest rows remain, also when thinning merges none."""
    history, capacity_as = History(), cell_curves().capacity_as
    for day in range(0, 400, 10):
        later = rows.copy()
        later["elapsed_s"] += day * DAY_S
        for part in np.array_split(later, 3):
            history.append(part, capacity_as)
            assert history.rows.size <= MAX_ROWS
    assert history.rows[-1].tobytes() == later[-1].tobytes()
    assert np.all(np.diff(history.rows["elapsed_s"]) > 0.0)
    recent = rows.copy()
    recent["elapsed_s"] = np.linspace(0.0, DAY_S, rows.size)
    history = History()
    for _ in range(2 + MAX_ROWS // rows.size):
        history.append(recent, capacity_as)
    assert history.rows.size <= MAX_ROWS


def test_number_of_segments_is_bounded(rows: np.ndarray) -> None:
    """A source that is interrupted after each row would otherwise add unknowns without limit."""
    history, capacity_as = History(), cell_curves().capacity_as
    for segment, row in enumerate(rows[: 3 * MAX_SEGMENTS]):
        part = np.array([row, row])
        part["segment"] = segment
        history.append(part, capacity_as)
    assert np.unique(history.rows["segment"]).tolist() == list(range(2 * MAX_SEGMENTS, 3 * MAX_SEGMENTS))
    assert history.rows.size == 2 * MAX_SEGMENTS


def interrupted(rows: np.ndarray, size: int, gap_s: float = 60.0) -> list[np.ndarray]:
    """Return parts of ``size`` rows as segments of their own, with gaps at rest in which no charge flows."""
    parts = [rows[start : start + size].copy() for start in range(0, rows.size, size)]
    drawn_as = 0.0
    for number, part in enumerate(parts):
        part["segment"], part["gap_s"] = number, gap_s
        part["elapsed_s"] += number * gap_s
        end_as = part["charge_as"][-1]
        part["charge_as"] -= drawn_as
        drawn_as = end_as
    return parts


def test_segments_with_a_known_soc_outlast_interruptions(rows: np.ndarray) -> None:
    """A log that is interrupted every few rows would otherwise lose the ends of charge of more than a few days."""
    cell, history = cell_curves(), History()
    parts = interrupted(rows[: 8 * 2 * MAX_SEGMENTS], 8)
    known = [*range(3, len(parts) // 2, 10)]
    for number, part in enumerate(parts):
        end = reference_row(part, 0.9, 0.01) if number in known else part[:0]
        history.append(np.concatenate([part, end]), cell.capacity_as)
    segments = np.unique(history.rows["segment"])
    assert segments.size == MAX_SEGMENTS
    assert set(known) <= set(segments.tolist())
    assert segments[-1] == len(parts) - 1


def test_charge_and_duration_of_dropped_segments_are_counted_in_the_next_gap(rows: np.ndarray) -> None:
    cell, history = cell_curves(), History()
    parts = interrupted(rows[: 8 * 2 * MAX_SEGMENTS], 8)
    for part in parts:
        history.append(part, cell.capacity_as)
    kept, whole = history.rows, np.concatenate(parts)
    first_as, starts = kept["charge_as"][0], np.flatnonzero(np.diff(kept["segment"])) + 1
    # each counter begins at the last row of the segment before
    to_start_as = np.repeat(
        np.cumsum(kept["charge_as"][np.append(starts, kept.size) - 1]), np.diff(np.r_[0, starts, kept.size])
    )
    ends_as = kept["charge_as"][np.append(starts, kept.size) - 1]
    total_as = kept["charge_as"] + to_start_as - np.repeat(ends_as, np.diff(np.r_[0, starts, kept.size]))
    at = np.searchsorted(whole["elapsed_s"], kept["elapsed_s"])
    np.testing.assert_allclose(total_as - first_as, rows["charge_as"][at] - rows["charge_as"][at[0]], atol=1e-6)
    is_after_dropped = np.diff(kept["segment"])[starts - 1] > 1.0
    assert is_after_dropped.any()
    assert np.all(kept["gap_s"][starts][is_after_dropped] > 60.0)


def test_segments_at_rest_are_dropped_first(rows: np.ndarray) -> None:
    cell, history = cell_curves(), History()
    moving, resting = interrupted(rows[: 40 * (MAX_SEGMENTS - 10)], 40), rows[:2].copy()
    resting["charge_as"] = 0.0
    number = 0
    for part in moving:
        for each in (part, resting.copy()):
            each["segment"], each["elapsed_s"] = number, each["elapsed_s"] - each["elapsed_s"][0] + 1e5 * number
            history.append(each, cell.capacity_as)
            number += 1
    sizes = np.unique(history.rows["segment"], return_counts=True)[1]
    assert (sizes > 2).sum() == len(moving)


def test_fit_of_the_thinned_history_differs_by_less_than_its_std(rows: np.ndarray) -> None:
    cell = cell_curves()
    known = reference_row(rows, float(rows["soc"][-1]), 0.01)
    whole = np.concatenate([rows, known])
    before, after = fit(cell, whole), fit(cell, thin_old_rows(whole, cell.capacity_as))
    std = np.sqrt(np.diag(before.covariance))
    difference = np.abs(after.mean - before.mean)
    assert np.all(difference[[SOC, LN_Q]] < std[[SOC, LN_Q]])
    assert np.all(difference[CURVE] < 0.5 * std[CURVE])
    lowest = rows["soc"].min()
    passed = lowest < SOC_GRID  # below, the curve follows from its prior
    assert np.all(np.abs(after.curve_v - before.curve_v)[passed] < 0.02)
