"""Queries on the voltages of single cells, on simulated packs with known faults."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.hour_row import HOUR_S, Hour
from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank
from tests.fleet.hour_rows import BEGIN, make_hour

DAYS, CELLS, PACKS = 30, 8, 20
LEAKING, WEAK, IMBALANCED = "p3", "p7", "p11"
SERIES, CAPACITY_AH, STEP_S, BLOCK = 12, 50.0, 30.0, 120
"""Number of simulated cells, their capacity [Ah], the interval of the samples [s], and the number of samples of a block."""
NOISE_V, OFFSET_V, RESOLUTION_V, WARMER_K = 5e-4, 1e-3, 1e-3, 5.0
"""Noise of a reading, std of its offset, its resolution [V], and temperature of the last cell above the first one [K]."""
SHORTED_CELL = 4
"""Index of the cell with a short."""
STORE_NS = BEGIN * HOUR_S * 10**9


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with healthy packs and three faulty ones, each with four hours a day at a changing SOC."""
    folder, rng = tmp_path_factory.mktemp("cells"), np.random.default_rng(1)
    rows = []
    for n in range(PACKS):
        initial = 0.005 * rng.standard_normal(CELLS)
        for day in range(DAYS):
            for hour in range(0, 24, 6):
                deviation = initial + 0.001 * rng.standard_normal(CELLS)
                deviation[4] -= 0.003 * day if f"p{n}" == LEAKING else 0.0
                deviation[5] += 0.08 if f"p{n}" == IMBALANCED else 0.0
                deviation[2] -= 0.08 if f"p{n}" == WEAK else 0.0
                deviation -= deviation.mean()
                weakest = int(np.argmin(deviation))
                values = {
                    "soc": 0.5,
                    "weakest_cell": weakest + 1,
                    "weakest_cell_soc_deviation": float(deviation[weakest]),
                    "weakest_cell_resistance_ratio": 1.0 + 0.5 * (weakest == 2),
                    "cell_soc_spread": float(np.ptp(deviation)),
                    "self_discharge_cell": 5,
                    "self_discharge_a": 0.005 if f"p{n}" == LEAKING else 0.002,
                    "self_discharge_std_a": 0.001,
                }
                rows.append(make_hour(f"p{n}", BEGIN + 24 * day + hour, **values))
    write(folder, rows)
    return folder


def test_cell_whose_soc_is_below_the_others_is_found(folder):
    rows = {row["pack"]: row for row in run_query(folder, "weak-cells").records}
    assert {pack: row["cell"] for pack, row in rows.items()} == {WEAK: 3, LEAKING: 5}
    assert rows[WEAK]["soc_deviation"] == pytest.approx(-0.08 * 7 / 8, abs=0.01)
    assert (rows[WEAK]["fraction"], rows[WEAK]["resistance_ratio"]) == (1.0, 1.5)


def test_packs_whose_cells_differ_in_soc_are_found_with_the_trend(folder):
    rows = {row["pack"]: row for row in run_query(folder, "imbalance").records}
    assert rows.keys() == {IMBALANCED, LEAKING, WEAK}
    assert rows[IMBALANCED]["soc_spread_per_30_days"] == pytest.approx(0.0, abs=0.01)
    assert rows[LEAKING]["lowest_cell"] == 5
    assert rows[LEAKING]["soc_spread_per_30_days"] == pytest.approx(0.09, abs=0.02)


def test_cell_with_a_significant_self_discharge_is_found(folder):
    (row,) = run_query(folder, "self-discharge").records
    assert (row["pack"], row["cell"]) == (LEAKING, 5)
    assert (row["self_discharge_ma"], row["self_discharge_std_ma"]) == (pytest.approx(5.0), pytest.approx(1.0))
    assert row["percent_per_day"] == pytest.approx(100 * 24 * 0.005 / 3.0)


def hourly_rows(short_ohm):
    """Return the hourly rows of three days with a discharge, a rest and a charge each day, and a short from the second day on."""
    rng, cell = np.random.default_rng(1), load_cell("nmc", CAPACITY_AH)
    drawn = replace(BankCells.drawn(rng, SERIES, CAPACITY_AH, 0.9), warmer_k=np.linspace(0.0, WARMER_K, SERIES))
    bank, offset_v = SimulatedBank(cell, drawn), OFFSET_V * rng.standard_normal(SERIES)
    settings = Settings(pack=PackSettings(cell="nmc", capacity_ah=CAPACITY_AH, series=SERIES))
    model = cell.pack(SERIES, 1)
    partition, rows = Partition(0, lambda _: (settings, model)), []
    blocks_of_hour = round(HOUR_S / (STEP_S * BLOCK))
    for number in range(1, 24 * 3 * blocks_of_hour + 1):
        hour = (number - 1) // blocks_of_hour
        leaks = np.full(SERIES, np.inf)
        leaks[SHORTED_CELL] = short_ohm if hour >= 24 else np.inf
        bank.cells = replace(drawn, leak_ohm=leaks)
        history = bank.run(current_a(rng, hour, float(bank.soc.mean())), STEP_S, 22.0 + 8.0 * np.sin(hour * np.pi / 12))
        noise_v = NOISE_V * rng.standard_normal(history.cell_v.shape)
        cells_v = np.round((history.cell_v + offset_v + noise_v) / RESOLUTION_V) * RESOLUTION_V
        samples = history.samples(rng, 2e-3, 0.01)
        arrival_s = STORE_NS / 1e9 + float(samples["time_s"][-1])
        data = encode(Block(STORE_NS, number, 1, arrival_s, samples, cells_v))
        rows += [Hour.model_validate_json(row) for _, row in partition.take("pack", data, number).hours]
    return rows


def current_a(rng, hour, soc):
    """Return the currents of a block: discharge until noon, then rest, charge from 18 h on [A]."""
    hour_of_day = hour % 24
    if 11 <= hour_of_day < 18 or (hour_of_day < 11 and soc < 0.25) or (hour_of_day >= 18 and soc > 0.9):
        return np.zeros(BLOCK)
    direction = 1.0 if hour_of_day < 11 else -1.9
    return CAPACITY_AH * direction * 0.055 * np.maximum(1.0 + 0.3 * rng.standard_normal(BLOCK), 0.0)


def test_internal_short_of_a_simulated_pack_is_found_with_its_current_and_a_healthy_pack_is_not(tmp_path):
    for name, short_ohm in (("shorted", 30.0), ("healthy", np.inf)):
        rows = hourly_rows(short_ohm)
        write(tmp_path, [row.model_copy(update={"pack": name}) for row in rows])
    (row,) = run_query(tmp_path, "self-discharge").records
    assert (row["pack"], row["cell"]) == ("shorted", SHORTED_CELL + 1)
    assert row["self_discharge_ma"] == pytest.approx(1000 * 3.8 / 30.0, rel=0.15)


@pytest.mark.parametrize(
    "values",
    [
        {"self_discharge_a": 0.005, "self_discharge_std_a": 0.004},  # not significant
        {"self_discharge_a": 0.00005, "self_discharge_std_a": 0.00001},  # below C/30,000
        {"self_discharge_a": -0.005, "self_discharge_std_a": 0.001},
        {},  # an hour of an earlier worker, or before the first estimate
    ],
)
def test_other_self_discharge_is_not_reported(tmp_path, values):
    write(tmp_path, [make_hour("a", BEGIN, self_discharge_cell=1, **values)])
    assert run_query(tmp_path, "self-discharge").rows == []


def test_fleet_without_cell_voltages_has_no_rows(tmp_path):
    write(tmp_path, [make_hour("a", BEGIN + n, soc=0.5) for n in range(30)])
    for name in ("weak-cells", "imbalance", "self-discharge"):
        assert run_query(tmp_path, name).rows == []
