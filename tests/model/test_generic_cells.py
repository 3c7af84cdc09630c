"""Generic cells of each chemistry, and a given capacity that replaces that of a cell file."""

import csv

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_plausibility import implausible_settings
from bms_estimator.estimator.stability_conditions import failed_conditions
from bms_estimator.kernels.step import SampleOutcome
from bms_estimator.model.cell import generic_cells, load_cell, shipped_cells
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.replay import load_capture

OHM_AH_10_S = {"lfp": 0.045, "nmc": 0.13, "nca": 0.13, "lco": 0.13, "lmo": 0.08, "lto": 0.016}
"""Typical resistance after 10 s at SOC 0.5 [ohm Ah], with a tolerance of 20 %. A cell of 100 Ah LFP has 0.45 mohm."""
TAU_S = np.array([1.0, 6.0, 30.0, 120.0, 500.0, 2000.0])
"""Time constants of the ladder [s]."""


def ocv_table(name):
    """Return the OCV table of a generic cell."""
    ocv = load_cell(name, 1.0).ocv
    assert isinstance(ocv, TableOcv)
    return ocv


def test_each_chemistry_has_a_generic_cell():
    assert generic_cells() == ["lco", "lfp", "lmo", "lto", "nca", "nmc"]
    assert set(generic_cells()).isdisjoint(shipped_cells())


@pytest.mark.parametrize("name", generic_cells())
def test_a_generic_cell_is_plausible_and_runs(name):
    cell = load_cell(name, 100.0)
    assert cell.cell.capacity_ah == 100.0
    assert cell.cell.voltage_min_v < cell.ocv.ocv_v[0]
    assert cell.ocv.ocv_v[-1] < cell.cell.voltage_max_v
    settings = Settings(pack=PackSettings(cell=name, capacity_ah=100.0), sensor=SensorSettings(protocol="text"))
    assert implausible_settings(settings, cell) == []
    assert failed_conditions(cell) == []
    assert Estimator(cell, identifier=None).step(0.0, 0.0, cell.cell.nominal_voltage_v) is SampleOutcome.ACCEPTED


@pytest.mark.parametrize("name", generic_cells())
def test_the_ocv_of_a_generic_cell_increases_and_has_a_plausible_error(name):
    ocv = ocv_table(name)
    soc = np.array(ocv.soc)
    assert (soc[0], soc[-1]) == (0.0, 1.0)
    ocv_v = PchipInterpolator(soc, ocv.ocv_v)(np.linspace(0.0, 1.0, 1001))
    assert (np.diff(ocv_v) > 0).all()
    middle = (soc >= 0.2) & (soc <= 0.9)
    error_v = np.array(ocv.error_v)[middle]
    # curves of one chemistry differ by more than a few millivolts, but by less than 100 mV
    assert error_v.min() >= 0.01
    assert error_v.max() <= 0.1
    assert max(ocv.hysteresis_v) <= 0.02


@pytest.mark.parametrize("name", generic_cells())
def test_the_elements_of_a_generic_cell_are_equivalent_to_its_ladder(name):
    """r_s is the ladder's first resistance. r_ts and r_tl are sums of three RC pairs, with their mean time constants."""
    cell = load_cell(name, 1.0)
    ladder = np.array(cell.ladder.weak_ohm) + np.array(cell.ladder.strong_ohm)
    soc = np.array(cell.ladder.soc)
    for section, rows in ((cell.r_s, ladder[:1]), (cell.r_ts, ladder[1:4]), (cell.r_tl, ladder[4:])):
        amplitude, exponent, offset = section.a
        assert rows.sum(axis=0) == pytest.approx(amplitude * np.exp(-exponent * soc) + offset, rel=2e-3)
    for r, c, rows, tau_s in (
        (cell.r_ts, cell.c_ts, ladder[1:4], TAU_S[:3]),
        (cell.r_tl, cell.c_tl, ladder[4:], TAU_S[3:]),
    ):
        # The offsets are the values near SOC 1, the last column.
        assert r.offset_ohm * c.offset_farad == pytest.approx(tau_s @ rows[:, -1] / rows[:, -1].sum(), rel=2e-3)


@pytest.mark.parametrize("name", generic_cells())
def test_the_resistance_of_a_generic_cell_after_10_s_is_typical(name):
    ladder = load_cell(name, 1.0).ladder
    index = ladder.soc.index(0.5)
    ohm = np.array(
        [weak[index] + strong[index] for weak, strong in zip(ladder.weak_ohm, ladder.strong_ohm, strict=True)]
    )
    # The first resistance is R_s. RC pairs contribute as far as they settle in 10 s.
    assert ohm[0] + ohm[1:] @ -np.expm1(-10.0 / TAU_S) == pytest.approx(OHM_AH_10_S[name], rel=0.2)


@pytest.mark.parametrize("name", generic_cells())
def test_capacity_scales_a_generic_cell_like_cells_in_parallel(name):
    assert load_cell(name, 100.0) == load_cell(name, 1.0).pack(1, 100)
    small, large = load_cell(name, 2.0), load_cell(name, 200.0)
    resistances, capacitances = [1, 3, 13], [7, 9, 12]  # indices of some amplitudes and offsets
    assert large.a[resistances] == pytest.approx(small.a[resistances] / 100)
    assert large.a[capacitances] == pytest.approx(small.a[capacitances] * 100)
    assert np.array(large.ladder.weak_ohm) == pytest.approx(np.array(small.ladder.weak_ohm) / 100)
    assert large.cell.current_max_a == pytest.approx(100 * small.cell.current_max_a)
    assert large.ocv == small.ocv
    assert (large.ladder.std, large.ladder.error_v) == (small.ladder.std, small.ladder.error_v)


def deviation_in_std(name, soc, ocv_v):
    """Return the deviations of a real cell's OCV from the generic one, in standard deviations of the generic one."""
    ocv = ocv_table(name)
    return np.abs(ocv_v - PchipInterpolator(ocv.soc, ocv.ocv_v)(soc)) / np.interp(soc, ocv.soc, ocv.error_v)


def charge_and_voltage(path, sign):
    """Return charge [Ah] and voltage [V] during the load with this sign (1: discharge, -1: charge).

    The charge is counted from the first sample of the load.
    """
    capture = load_capture(path)
    charge_ah = np.cumsum(capture["current_a"] * np.diff(capture["time_s"], prepend=capture["time_s"][0])) / 3600
    is_load = np.sign(np.round(capture["current_a"], 3)) == sign
    return np.abs(charge_ah[is_load] - charge_ah[is_load][0]), capture["voltage_v"][is_load]


def test_the_declared_error_of_the_ocv_covers_the_leaf_and_the_lg_m50(data):
    with (data / "lgm50" / "ocv_25c.csv").open() as file:
        soc, ocv_v = np.array([(float(row["soc"]), float(row["ocv_v"])) for row in csv.DictReader(file)]).T
    leaf = load_cell("leaf").ocv
    for deviation, min_fraction in (
        (deviation_in_std("nmc", soc, ocv_v), 0.95),
        (deviation_in_std("lmo", np.array(leaf.soc), leaf.ocv_v), 0.9),
    ):
        assert (deviation <= 2.0).mean() >= min_fraction
        assert deviation.mean() > 0.3  # the error is not much too large


@pytest.mark.parametrize(
    ("name", "discharge", "charge"),
    [
        ("nca", "panasonic18650pf/25_c20", "panasonic18650pf/25_c20"),
        ("nca", "ncr18650/cell1_discharge_c20", "ncr18650/cell1_charge_c20"),
        ("lfp", "a123/c30_dis_p25", "a123/c30_chg_p25"),
    ],
)
def test_the_declared_error_of_the_ocv_covers_cells_that_were_not_used_for_it(name, discharge, charge, shared_data):
    """The true OCV is the mean of a slow discharge and a slow charge.

    The SOC of each is counted with its own total charge.
    """
    soc = np.linspace(0.0, 1.0, 101)
    discharged_ah, discharge_v = charge_and_voltage(shared_data / f"{discharge}.csv.gz", 1)
    charged_ah, charge_v = charge_and_voltage(shared_data / f"{charge}.csv.gz", -1)
    ocv_v = (
        np.interp(1 - soc, discharged_ah / discharged_ah[-1], discharge_v)
        + np.interp(soc, charged_ah / charged_ah[-1], charge_v)
    ) / 2
    deviation = deviation_in_std(name, soc, ocv_v)
    assert (deviation <= 2.0).mean() >= 0.95
    assert deviation.mean() > 0.3  # the error is not much too large


def test_the_error_on_a_generic_cell_without_capacity_contains_the_remedy():
    with pytest.raises(UserError, match=r"lfp is a generic cell: give its capacity.*--capacity-ah"):
        load_cell("lfp")


@pytest.mark.parametrize("capacity_ah", [0.0, -3.0, float("nan"), float("inf")])
def test_an_invalid_capacity_is_rejected(capacity_ah):
    with pytest.raises(UserError, match=r"capacity_ah = .*: must be above 0"):
        load_cell("leaf", capacity_ah)


def test_a_given_capacity_replaces_only_the_capacity_of_a_cell_file():
    """An aged cell has a smaller capacity and the measured resistances."""
    aged_cell, new_cell = load_cell("leaf", 24.0), load_cell("leaf")
    assert aged_cell.cell.capacity_ah == 24.0
    assert aged_cell.model_copy(update={"cell": new_cell.cell}) == new_cell
    assert aged_cell.cell.model_copy(update={"capacity_ah": new_cell.cell.capacity_ah}) == new_cell.cell
