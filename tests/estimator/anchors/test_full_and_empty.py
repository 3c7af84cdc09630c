"""Ends of charge and discharge that correct the SOC: weeks of simulated use, and real captures."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.anchor_settings import between_limits
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock, SampleStatus
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.payloads.health import AnchorReport
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.observer import NO_LIMITS, ChargeLimits
from bms_estimator.sources.captures.replay import load_capture
from bms_estimator.telemetry.health import identifier_counters, last_anchor
from tests.estimator.anywhere.cases import OXIDE
from tests.estimator.anywhere.truth import simulate
from tests.estimator.anywhere.use import DAY_S, drive
from tests.fit_interval import fits_every

CAPACITY_AH = OXIDE.capacity_ah
FULL_V = float(OXIDE.ocv_v[-1])
"""Voltage of the charger [V]."""
DAYS = 5
"""Number of simulated days."""
FIT_INTERVAL_S = 6.0 * 3600.0
"""Interval between two slow fits [s]."""


def days_with_a_charge() -> tuple[SampleBlock, Floats]:
    """Return the samples at 1 Hz of days with a drive, a rest and a charge to full, and the true SOC.

    SOC 1 is defined by the end of the first charge.
    """
    rng, parts = np.random.default_rng(1), []
    for _ in range(DAYS):
        down = drive(rng, CAPACITY_AH, 0.4, int(rng.uniform(2400, 4800)))
        rest, charge = np.zeros(7200), np.full(5 * 3600, -0.4 * CAPACITY_AH)
        parts += [down, rest, charge, np.zeros(DAY_S - down.size - rest.size - charge.size)]
    current_a = np.concatenate(parts)
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["temperature_c"] = np.arange(current_a.size), 25.0
    curves = OXIDE.ocv_v, OXIDE.per_kelvin_v, OXIDE.hysteresis_v, OXIDE.ohm
    soc, hysteresis = 0.9, -1.0  # at rest after a discharge
    limits = {"low_v": float(OXIDE.ocv_v[0]), "high_v": FULL_V}
    voltage_v, soc = simulate(1.0, current_a, samples["temperature_c"], soc, hysteresis, CAPACITY_AH, *curves, **limits)
    samples["current_a"] = np.round(current_a + rng.normal(0.0, 2e-3, soc.size), 3)
    samples["voltage_v"] = np.round(voltage_v + rng.normal(0.0, 5e-4, soc.size), 3)
    return samples, np.minimum(soc + 1.0 - soc.max(), 1.0)


def test_the_ends_of_charge_keep_the_soc_of_a_generic_cell_right() -> None:
    """Without the ends of charge, the RMSE is 4.7 % and 9 % of the time is inside two std."""
    samples, soc = days_with_a_charge()
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), limits=ChargeLimits(full_voltage_v=FULL_V))
    with fits_every(FIT_INTERVAL_S):
        trace = Pack(estimator, SlowFit(estimator, interval_s=FIT_INTERVAL_S)).run(samples).trace
    assert identifier_counters(estimator.record[0])["full_anchors"] == DAYS
    after_first_day = slice(DAY_S, None)
    error = trace["soc"][after_first_day] - soc[after_first_day]
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert np.mean(np.abs(error) < 2.0 * trace["soc_std"][after_first_day]) > 0.95


@pytest.mark.parametrize("status", [pytest.param(0, marks=pytest.mark.thorough), SampleStatus.GAP])
def test_sparse_samples_in_the_constant_voltage_phase_have_an_anchor(status: int) -> None:
    """A cycler that writes a row at each change of the voltage writes one in some minutes, and one at the end of the charge."""
    samples, _ = days_with_a_charge()
    is_charge = (samples["current_a"] < -0.02 * CAPACITY_AH) & (samples["voltage_v"] > FULL_V - 0.004)
    is_last = is_charge & (np.append(samples["current_a"][1:], 0.0) > -0.02 * CAPACITY_AH)
    sparse = samples[~is_charge | is_last | (np.arange(samples.size) % 200 == 0)]
    sparse["status"][1:][np.diff(sparse["time_s"]) > 60.0] |= np.uint32(status)
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), limits=ChargeLimits(full_voltage_v=FULL_V))
    estimator.run(sparse)
    assert identifier_counters(estimator.record[0])["full_anchors"] == DAYS


def test_live_samples_and_blocks_have_equal_anchors() -> None:
    samples, _ = days_with_a_charge()
    part = samples[: 12 * 3600]
    of_block, of_samples = (
        Estimator(load_cell("nmc", CAPACITY_AH), limits=ChargeLimits(full_voltage_v=FULL_V)) for _ in range(2)
    )
    of_block.run(part)
    for row in part:
        of_samples.step(row["time_s"], row["current_a"], row["voltage_v"], 0, row["temperature_c"])
    assert of_block.record["anchors"]["full_anchors"] == 1
    assert of_block.record.tobytes() == of_samples.record.tobytes()


def charge_to_4_1_v(cell: CellModel) -> AnchorReport:
    """Return the anchor after the end of a charge to 4.1 V."""
    current_a = np.r_[np.zeros(60), np.full(3600, -0.06 * cell.cell.capacity_ah), np.zeros(600)]
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = np.arange(current_a.size), current_a, 25.0
    samples["voltage_v"] = np.where(current_a < 0.0, 4.1, 4.09)
    estimator = Estimator(cell, limits=ChargeLimits(full_voltage_v=4.1))
    estimator.run(samples)
    anchor = last_anchor(estimator.record[0])
    assert anchor is not None
    assert anchor.kind == "full"
    return anchor


def test_an_end_of_charge_that_contradicts_a_measured_curve_is_reported_and_corrects_nothing() -> None:
    """The charger ends at 4.1 V, where the curve of the cell file has SOC 0.92."""
    anchor = charge_to_4_1_v(load_cell("ncr18650"))
    assert anchor.soc_after == anchor.soc_before == pytest.approx(0.92, abs=0.03)


def test_a_generic_curve_is_full_where_the_charger_ends() -> None:
    assert charge_to_4_1_v(load_cell("nmc", CAPACITY_AH)).soc_after == pytest.approx(1.0, abs=0.01)


def test_a_generic_curve_lies_between_the_voltages_of_protection_and_charger() -> None:
    generic, limits = load_cell("nmc", CAPACITY_AH), ChargeLimits(full_voltage_v=4.1, cutoff_voltage_v=3.3)
    p, whole = (Estimator(generic, limits=each).cell_file_settings for each in (limits, NO_LIMITS))
    assert p["ocv_v"][[0, -1]] == pytest.approx([3.3, 4.1], abs=2e-3)
    soc = np.linspace(0.0, 1.0, p["ocv_v"].size)
    low, high = np.interp([3.3, 4.1], whole["ocv_v"], soc)
    assert p["ocv_v"] == pytest.approx(np.interp(low + (high - low) * soc, soc, whole["ocv_v"]), abs=3e-3)
    assert p["capacity_as"] == whole["capacity_as"]


def test_voltages_of_another_pack_leave_a_generic_curve_unchanged() -> None:
    generic = load_cell("nmc", CAPACITY_AH)
    assert between_limits(generic, ChargeLimits(full_voltage_v=3.5)) is generic


@pytest.mark.parametrize(("gap_s", "anchors"), [(7200.0, 1), (20.0, 0)])
def test_a_gap_that_begins_at_the_cutoff_voltage_under_load_ends_the_discharge(gap_s: float, anchors: int) -> None:
    """The protection disconnects the electronics, too, so that no rest is measured. The pack is charged in the gap."""
    curves = OXIDE.ocv_v, OXIDE.per_kelvin_v, OXIDE.hysteresis_v, OXIDE.ohm
    current_a = np.full(6 * 3600, 0.2 * CAPACITY_AH)
    voltage_v, _ = simulate(1.0, current_a, np.full(current_a.size, 25.0), 0.6, -1.0, CAPACITY_AH, *curves)
    end = int(np.argmax(voltage_v < OXIDE.ocv_v[0])) + 10
    samples = np.zeros(end + 30, dtype=SAMPLE)
    samples["time_s"], samples["temperature_c"] = np.arange(samples.size), 25.0
    samples["current_a"][:end], samples["voltage_v"][:end] = current_a[:end], voltage_v[:end]
    samples["time_s"][end:] += gap_s
    samples["voltage_v"][end:] = OXIDE.ocv_v[-1]
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), limits=ChargeLimits(cutoff_voltage_v=float(OXIDE.ocv_v[0])))
    estimator.run(samples)
    assert identifier_counters(estimator.record[0])["empty_anchors"] == anchors
    if anchors:
        anchor = last_anchor(estimator.record[0])
        assert anchor is not None
        assert anchor.soc_after < anchor.soc_before < 0.06


def anchors_of(path: Path, chemistry: str, capacity_ah: float) -> Estimator:
    """Run a generic cell on a capture."""
    rows = load_capture(path).rows
    estimator = Estimator(load_cell(chemistry, capacity_ah))
    estimator.run(rows[rows["voltage_v"] > 1.5])  # without glitches
    return estimator


@pytest.mark.parametrize("name", ["c30_chg_p25", "c30_chg_p05", "c30_chg_n15"])
def test_the_end_of_a_slow_charge_of_a_real_lfp_cell_is_full(shared_data: Path, name: str) -> None:
    """In the cold the voltage alone leaves the SOC at 0.73 to 0.77."""
    estimator = anchors_of(shared_data / "a123" / f"{name}.csv.gz", "lfp", 2.05)
    assert identifier_counters(estimator.record[0])["full_anchors"] == 1
    assert estimator.state["soc"][0] > 0.99


@pytest.mark.parametrize(
    ("name", "chemistry", "capacity_ah"),
    [
        ("panasonic18650pf/25_us06", "nca", 2.99),
        ("panasonic18650pf/n10_us06", "nca", 2.99),
        ("panasonic18650pf/0_cycle1", "nca", 2.99),
        ("panasonic18650pf/25_hppc", "nca", 2.99),
        ("a123/dyn_p25", "lfp", 2.05),
        ("ncr18650/cell1_dst", "nca", 3.0),
    ],
)
def test_drives_and_pulses_from_full_have_no_anchor(
    shared_data: Path, name: str, chemistry: str, capacity_ah: float
) -> None:
    """0_cycle1 pauses at the cut-off voltage in the cold with 15 % of its charge left."""
    estimator = anchors_of(shared_data / f"{name}.csv.gz", chemistry, capacity_ah)
    assert last_anchor(estimator.record[0]) is None
