"""Exchange of the pack in a gap. It is detected in the first hour of use, and the fit does not average both packs."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.rc_ladder import HIGH_ACTIVATION_ENERGY, LOW_ACTIVATION_ENERGY, TAUS
from bms_estimator.model.cell import load_cell
from bms_estimator.model.input_faults import InputFault
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model import slow_fit as slow_fit_module
from bms_estimator.pack_model.cell_curves import arrhenius
from bms_estimator.pack_model.fit import SOC, PackFit, fit
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.estimator.simulated_cell import TRUTH, measured
from tests.pack_model.histories import Truth, cell_curves, measured_rows, with_voltages
from tests.pack_model.quick_fit import quick_fit

OLD, AGED = Truth(soc=0.9), Truth(soc=0.9, ln_q=-0.22, ln_r=(0.4, 0.4, 0.4))
"""Pack before the gap, and a pack with a capacity 20 % smaller and resistances 1.5 times as large."""
HOUR_S = 3600.0


def after_gap(truth: Truth, hours: float) -> np.ndarray:
    """Return the rows of three days of one pack, and after a gap of two hours the first rows of another one."""
    cell = cell_curves()
    before = with_voltages(cell, measured_rows(cell), OLD)
    after = measured_rows(cell, days=2, segment=1, gap_s=2.0 * HOUR_S)
    after = with_voltages(cell, after[after["elapsed_s"] < hours * HOUR_S], truth)
    after["elapsed_s"] += before["elapsed_s"][-1] + before["duration_s"][-1] + 2.0 * HOUR_S
    return np.concatenate([before, after])


def fitted(rows: np.ndarray) -> PackFit:
    """Return the fit of the rows, after that of the rows before the gap."""
    cell = cell_curves()
    return fit(cell, rows, fit(cell, rows[rows["segment"] == 0.0]))


@pytest.mark.parametrize(
    ("truth", "exchanged"),
    [
        (AGED, True),
        (OLD, False),
        (replace(OLD, soc=0.7), False),
        (replace(OLD, ln_q=-0.02, ln_r=(0.05, 0.05, 0.05)), False),
    ],
)
def test_only_another_pack_after_a_gap_is_an_exchange(truth: Truth, exchanged: bool) -> None:
    result = fitted(after_gap(truth, hours=1.0))
    assert result.is_exchanged == exchanged
    assert result.first_segment == exchanged


@pytest.mark.parametrize("hours", [0.5, 1.0])
def test_load_that_continues_over_a_gap_is_no_exchange(hours: float) -> None:
    """The RC pairs are reset at the gap, so that the polarization by the load before it is unknown."""
    rows = after_gap(OLD, hours)
    is_after = rows["segment"] == 1.0
    rows["voltage_v"][is_after] -= drop_by_earlier_load(rows[is_after], load_c=1.5)
    result = fitted(rows)
    assert not result.is_exchanged
    assert abs(result.mean[SOC] - rows["soc"][-1]) < 0.015


def drop_by_earlier_load(rows: np.ndarray, load_c: float) -> np.ndarray:
    """Return the voltage drop that the RC pairs keep from a constant load before the first row [V]."""
    cell, temperature_c = cell_curves(), rows["temperature_c"]
    ohm = cell.resistances(
        rows["soc"], arrhenius(LOW_ACTIVATION_ENERGY, temperature_c), arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c)
    )[:, 1:]
    middle_s = rows["settled_s"] + 0.5 * rows["duration_s"]
    kept_a = load_c * cell.one_c_a * np.exp(-middle_s[:, None] / TAUS)
    return np.asarray(cell.series * (ohm * kept_a).sum(axis=1))


def test_exchanged_packs_are_not_averaged() -> None:
    rows = after_gap(AGED, hours=40.0)
    is_first_hour = (rows["segment"] == 0.0) | (np.arange(rows.size) < np.argmax(rows["segment"]) + 12)
    result = fit(cell_curves(), rows, fitted(rows[is_first_hour]))
    assert not result.is_exchanged
    assert result.first_segment == 1.0
    assert result.row_soc.size == (rows["segment"] == 1.0).sum()
    np.testing.assert_allclose(result.ln_r[16:33], 0.4, atol=0.1)


def test_temperature_that_was_never_measured_is_no_exchange() -> None:
    rows = after_gap(AGED, hours=1.0)
    rows["temperature_c"][rows["segment"] == 1.0] = 5.0
    assert not fitted(rows).is_exchanged


def test_exchange_raises_the_diagnostic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slow_fit_module, "fit", lambda *args: replace(quick_fit(*args), is_exchanged=True))
    current_a = np.tile(np.repeat([0.8, -0.8], 1800), 3) * TRUTH.cell.capacity_ah
    block = measured(current_a, 0.7, np.random.default_rng(1))[0]
    slow_fit = SlowFit(Estimator(load_cell("nca", TRUTH.cell.capacity_ah), initial_soc=0.7), interval_s=5000.0)
    suspects = slow_fit.estimator.record[0]["checks"]
    Pack(slow_fit.estimator, slow_fit).run(block[:1500])
    assert InputFault.PACK not in InputFault(int(suspects["suspects"]))
    Pack(slow_fit.estimator, slow_fit).run(block[1500:])
    assert slow_fit.fits > 0
    assert InputFault.PACK in InputFault(int(suspects["suspects"]))
