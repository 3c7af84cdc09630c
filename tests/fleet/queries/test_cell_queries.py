"""Query for packs with a faulty cell, on rows with known values and on simulated packs."""

import pytest

from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import write
from tests.benchmarks.fleet.failing_packs import FAULTY_CELL, rows_of_pack
from tests.fleet.hour_rows import BEGIN, make_hour

HEALTHY = {
    "weakest_cell": 1, "weakest_cell_soc_deviation": -0.02, "weakest_cell_soc_deviation_std": 0.003, "smallest_cell": 2,
    "smallest_cell_capacity_ratio": 0.96, "resistive_cell": 3, "resistive_cell_ratio": 1.1, "resistive_cell_ratio_std": 0.1,
    "self_discharge_cell": 4, "self_discharge_a": 0.0, "self_discharge_std_a": 0.001,
}  # fmt: skip
"""Fields of a row of a pack with healthy cells, whose capacity is 3 Ah."""


def failing(folder, *values):
    """Return the answer for a pack with one row for each of ``values``."""
    write(folder, [make_hour("a", BEGIN + n, **(HEALTHY | each)) for n, each in enumerate(values)])
    return [(row["quantity"], row["cell"], row["value"]) for row in run_query(folder, "failing").records]


@pytest.mark.parametrize(
    ("values", "quantity", "cell", "value"),
    [
        ({"weakest_cell_soc_deviation": -0.05}, "cell SOC", 1, -0.05),
        ({"smallest_cell_capacity_ratio": 0.85}, "cell capacity", 2, 0.85),
        ({"resistive_cell_ratio": 1.8}, "cell resistance", 3, 1.8),
        ({"self_discharge_a": 0.005}, "cell self-discharge", 4, 0.005),
    ],
)
def test_faulty_cell_is_named(tmp_path, values, quantity, cell, value):
    assert failing(tmp_path, values, values, HEALTHY) == [(quantity, cell, pytest.approx(value))]


@pytest.mark.parametrize(
    "values",
    [
        {
            "weakest_cell_soc_deviation": -0.07,
            "weakest_cell_soc_deviation_std": 0.017,
        },  # as by the readings of LFP cells
        {"resistive_cell_ratio": 1.5, "resistive_cell_ratio_std": 0.2},
        {"self_discharge_a": 0.005, "self_discharge_std_a": 0.004},
        {"self_discharge_a": 0.00005, "self_discharge_std_a": 0.00001},  # below C/30,000
        {"self_discharge_a": -0.005},
        {"weakest_cell": None},  # before the first estimate
    ],
)
def test_uncertain_or_small_deviation_is_not_named(tmp_path, values):
    assert failing(tmp_path, values, values) == []


def test_deviation_of_a_cell_in_few_hours_is_not_named(tmp_path):
    deviation = {"weakest_cell_soc_deviation": -0.2}
    assert failing(tmp_path, deviation, HEALTHY, deviation | {"weakest_cell": 7}, HEALTHY) == []


def test_alarms_of_a_faulty_cell_in_the_last_hour_are_named(tmp_path):
    assert failing(tmp_path, {}, {"alarms": "cell_short cell_imbalance weak_cell"}) == [
        ("alarm: cell_short", None, None),
        ("alarm: weak_cell", None, None),
    ]


def test_alarms_that_have_ended_are_not_named(tmp_path):
    assert failing(tmp_path, {"alarms": "cell_short"}, {}) == []


def test_cell_with_85_percent_of_the_capacity_is_named_and_a_healthy_pack_with_wrong_readings_is_not(tmp_path):
    for variant in ("85-percent", "offsets"):
        write(tmp_path, rows_of_pack("lfp", variant, days=6))
    records = run_query(tmp_path, "failing").records
    assert {(row["pack"], row["cell"]) for row in records} == {("lfp-85-percent", FAULTY_CELL)}
