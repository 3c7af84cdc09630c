"""Saving of history and fit, and published values relative to the cell file."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.estimator.identified_parameters import identified_cell, relative_series_resistance
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.pack_model.handover import adopt_curves
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.saved import curve_arrays, fit_from_arrays, history_arrays, history_from_arrays
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.parameters import make_parameters_payload
from tests.pack_model.quick_fit import CURVE_V, LN_PAIRS, LN_SERIES, quick_fit

CELL = load_cell("ncr18650")
SERIES = 4


def some_rows() -> np.ndarray:
    """Return rows of two segments."""
    rows = np.zeros(5, HISTORY_ROW)
    rows["elapsed_s"], rows["segment"] = 60.0 * np.arange(5), [0, 0, 0, 1, 1]
    rows["reference_soc"] = np.nan
    rows["gap_s"] = np.inf
    return rows


def test_history_and_fit_are_the_same_after_saving() -> None:
    rows = some_rows()
    fit = quick_fit(None, rows)  # type: ignore[arg-type]
    history, restored = history_from_arrays(history_arrays(History(rows), fit))
    assert history.rows.tobytes() == rows.tobytes()
    assert restored
    for field in fields(fit):
        assert np.array_equal(getattr(restored, field.name), getattr(fit, field.name)), field.name


@pytest.mark.parametrize(
    "change",
    [
        {"covariance": np.full((27, 27), np.nan)},
        {"curve_v": np.zeros(3)},
        {"rows": some_rows()[::-1]},
        {"rows": np.zeros(3)},
        {"row_soc": np.zeros(3)},
    ],
)
def test_damaged_arrays_are_rejected(change: dict[str, Any]) -> None:
    rows = some_rows()
    arrays = history_arrays(History(rows), quick_fit(None, rows))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"damaged|layout|order"):
        history_from_arrays(arrays | change)


def test_a_missing_field_of_the_curves_is_rejected() -> None:
    arrays = curve_arrays(quick_fit(None, some_rows()))  # type: ignore[arg-type]
    del arrays["ln_r"]
    with pytest.raises(ValueError, match="ln_r"):
        fit_from_arrays(arrays)


def fitted_estimator(cell: CellModel = CELL) -> Estimator:
    """Return an estimator at rest with the curves of a fit."""
    estimator = compiled_estimator(Settings(), cell.pack(SERIES, 1))
    file_settings = estimator.cell_file_settings
    adopt_curves(estimator.settings_record[0]["filter"], file_settings, quick_fit(None, some_rows()))  # type: ignore[arg-type]
    for second in range(30):
        estimator.step(float(second), 0.0, 3.8 * SERIES)
    return estimator


def test_r_s_is_relative_to_the_cell_file() -> None:
    estimator = fitted_estimator()
    ratio = make_parameters_payload(estimator, 0.0).state_of_health["r_s"]
    direct = relative_series_resistance(estimator.record[0], estimator.settings_record[0], estimator.cell_file_settings)
    assert direct.value == pytest.approx(np.exp(LN_SERIES), rel=0.02)
    assert (ratio.source, ratio.value) == ("configured", 1.0)  # at rest no data identifies R_s


def test_the_published_curve_contains_the_fit() -> None:
    estimator = fitted_estimator()
    curve = make_parameters_payload(estimator, 0.0).ocv
    estimator.return_to_cell_file()
    file_curve = make_parameters_payload(estimator, 0.0).ocv
    assert curve
    assert file_curve
    assert np.mean(np.subtract(curve.ocv_v, file_curve.ocv_v)) == pytest.approx(SERIES * CURVE_V, rel=0.3)


def test_an_exported_cell_has_the_fitted_curves() -> None:
    cell = identified_cell(fitted_estimator(), CELL, SERIES)
    assert cell.r_s.offset_ohm / CELL.r_s.offset_ohm == pytest.approx(np.exp(LN_SERIES), rel=0.02)
    assert cell.r_tl.offset_ohm / CELL.r_tl.offset_ohm == pytest.approx(np.exp(LN_PAIRS), rel=0.05)
    assert isinstance(cell.ocv, TableOcv)
    assert isinstance(CELL.ocv, TableOcv)
    assert np.mean(np.subtract(cell.ocv.ocv_v, CELL.ocv.ocv_v)) == pytest.approx(CURVE_V, rel=0.3)


def test_an_exported_ladder_has_the_fitted_resistances() -> None:
    file_cell = load_cell("nmc", 3.0)
    cell = identified_cell(fitted_estimator(file_cell), file_cell, SERIES)
    assert cell.ladder
    assert file_cell.ladder
    fitted_ohm, file_ohm = np.array(cell.ladder.strong_ohm), np.array(file_cell.ladder.strong_ohm)
    assert fitted_ohm[0] == pytest.approx(np.exp(LN_SERIES) * file_ohm[0], rel=0.05)
    assert fitted_ohm[1:] == pytest.approx(np.exp(LN_PAIRS) * file_ohm[1:], rel=0.05)


def test_return_to_the_cell_file_keeps_the_resistances() -> None:
    estimator = fitted_estimator()
    before = relative_series_resistance(estimator.record[0], estimator.settings_record[0], estimator.cell_file_settings)
    soc = float(estimator.record["filter"]["soc"][0])
    estimator.return_to_cell_file()
    after = relative_series_resistance(estimator.record[0], estimator.settings_record[0], estimator.cell_file_settings)
    assert after.value == pytest.approx(before.value)
    assert estimator.record["filter"]["soc"][0] == soc
    assert estimator.settings_record[0]["filter"] == estimator.cell_file_settings
