"""Settings of the filter from a cell file and ``[identifier]``."""

import math

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import BRANCHES_STD, SLOW_DIFFUSION, SOC_GRID, ladder_of_branches
from bms_estimator.estimator.identified_parameters import present_elements
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.cell_model.rc_ladder import (
    GRID,
    HIGH_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    RESISTANCES,
    arrhenius,
)
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import Ladder, TableOcv
from bms_estimator.settings.observer import IdentifierSettings

CELL = load_cell("ncr18650")


def test_a_file_without_a_ladder_gets_one_equivalent_to_its_rc_pairs() -> None:
    """The elements that are computed from the ladder are those of the file."""
    estimator = Estimator(CELL, identifier=IdentifierSettings(soc_std=0.005), initial_soc=0.5)
    p = estimator.settings[0]
    estimator.step(0.0, 0.0, float(chen_mora.ocv(0.5, p["ocv_v"], p["ocv_slope_v"])))
    soc, a, elements = float(estimator.state["soc"][0]), CELL.a, present_elements(estimator.record[0])
    r_ts, r_tl = chen_mora.r_ts(soc, a), chen_mora.r_tl(soc, a)
    assert elements["r_s_ohm"].value == pytest.approx(chen_mora.r_s(soc, a), rel=1e-3)
    pairs_ohm = elements["r_ts_ohm"].value + elements["r_tl_ohm"].value
    # The tolerance covers the load that the filter assumes before the first sample.
    assert pairs_ohm == pytest.approx((1.0 + SLOW_DIFFUSION) * (r_ts + r_tl), rel=0.05)
    assert elements["r_ts_ohm"].value == pytest.approx(r_ts, rel=0.15)
    assert elements["c_ts_farad"].value == pytest.approx(chen_mora.c_ts(soc, a), rel=0.15)
    assert estimator.settings_record["filter"]["r_std"][0] == BRANCHES_STD
    assert all(math.isinf(element.age_s) for element in elements.values())  # not identified yet


def test_a_ladder_made_of_two_rc_pairs_has_their_resistances_over_soc() -> None:
    ohm, a = ladder_of_branches(CELL), CELL.a
    assert ohm.shape == (GRID, RESISTANCES)
    for soc, row in zip(SOC_GRID, ohm, strict=True):
        pairs_ohm = chen_mora.r_ts(soc, a) + chen_mora.r_tl(soc, a)
        assert row[0] == pytest.approx(chen_mora.r_s(soc, a))
        assert row[1:].sum() == pytest.approx((1.0 + SLOW_DIFFUSION) * pairs_ohm)


def test_resistances_of_two_rc_pairs_grow_in_the_cold_as_in_measured_cells() -> None:
    """In fits of two measured cells, resistances at 0 C are 2.4 times those at 25 C at SOC 0.5.

    At SOC 0.1 the ratio is 4.6 (NCA) and 2.7 (LFP).
    """
    p = Estimator(CELL.model_copy(update={"ladder": None})).settings_record[0]["filter"]
    cold_ratio = {}
    for soc in (0.5, 0.1):
        weak, strong = (float(p[name][round(soc * (GRID - 1))].sum()) for name in ("weak_ohm", "strong_ohm"))
        cold_ratio[soc] = (
            weak * arrhenius(LOW_ACTIVATION_ENERGY, 0.0) + strong * arrhenius(HIGH_ACTIVATION_ENERGY, 0.0)
        ) / (weak + strong)
    assert 2.0 < cold_ratio[0.5] < 2.8
    assert 1.2 * cold_ratio[0.5] < cold_ratio[0.1] < 4.6


def test_the_ladder_of_a_pack_in_series_is_interpolated_and_scaled() -> None:
    rows = tuple((0.001 * (k + 1), 0.002 * (k + 1)) for k in range(RESISTANCES))
    ladder = Ladder(
        soc=(0.0, 1.0), weak_ohm=rows, strong_ohm=rows, std=0.12, error_v=0.004, temperature_c=(-10.0, 25.0)
    )
    p = Estimator(CELL.model_copy(update={"ladder": ladder}).pack(3, 1)).settings_record[0]["filter"]
    # Three cells, each with the mean of the rows of SOC 0 and 1.
    assert p["weak_ohm"][GRID // 2] == pytest.approx(3.0 * 0.0015 * np.arange(1, RESISTANCES + 1))
    assert (p["r_std"], p["low_c"], p["high_c"], p["series"]) == (0.12, -10.0, 25.0, 3.0)


def test_a_configured_hysteresis_raises_an_ocv_measured_in_discharge_to_the_mean() -> None:
    """A table with ``hysteresis_v`` is already the mean of the OCV after charge and after discharge."""
    soc, ocv_v = (0.0, 0.3, 0.7, 1.0), (3.0, 3.25, 3.3, 3.5)
    discharge_curve_cell = CELL.model_copy(update={"ocv": TableOcv(form="table", soc=soc, ocv_v=ocv_v)})
    mean_curve_cell = CELL.model_copy(
        update={"ocv": TableOcv(form="table", soc=soc, ocv_v=ocv_v, hysteresis_v=(0.005, 0.01, 0.01, 0.005))}
    )
    configured = IdentifierSettings(hysteresis_v=0.03)
    for cell, raised_v in ((discharge_curve_cell, 0.015), (mean_curve_cell, 0.0)):
        without = Estimator(cell).settings_record[0]["filter"]
        p = Estimator(cell, identifier=configured).settings_record[0]["filter"]
        assert p["ocv_v"] - without["ocv_v"] == pytest.approx(raised_v)
        assert p["hysteresis_v"] == pytest.approx(0.015)
    assert without["hysteresis_v"].max() == pytest.approx(0.01)


def test_a_configured_std_of_0_disables_a_state_and_other_stds_are_used() -> None:
    off = IdentifierSettings(current_offset_std_a=0.0, capacity_std=0.0)
    p = Estimator(CELL, identifier=off).settings_record[0]["filter"]
    assert (p["offset_c"], p["capacity_std"]) == (0.0, 0.0)
    configured = IdentifierSettings(current_offset_std_a=0.1, soc_std=0.05)
    p = Estimator(CELL, identifier=configured).settings_record[0]["filter"]
    assert p["offset_c"] * p["capacity_as"] / 3600.0 == pytest.approx(0.1)
    assert p["soc_std"] == 0.05
    assert p["capacity_std"] > 0.0
