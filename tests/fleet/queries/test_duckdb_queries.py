"""Queries on simulated fleets with known true values and known error rates."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bms_estimator.fleet.queries.duckdb_queries import AGED_SOC, CHARGE_ERROR, QUERIES, run_query, select
from bms_estimator.fleet.queries.parquet_files import SCHEMA, compact, write
from bms_estimator.kernels.kalman_filter.records import Noise
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from tests.fleet.hour_rows import BEGIN, FIRST_STD, estimate_capacities, estimate_soc, make_hour, write_fleet


def test_process_noise_of_the_queries_equals_that_of_the_filter():
    assert (Noise.aged_soc, Noise.charge_error) == (AGED_SOC, CHARGE_ERROR)


PACKS, DAYS, SLOPE_PER_YEAR = 400, 60, -0.06
"""Number of packs, number of days, and mean change of ln(capacity) in a year."""


@pytest.fixture(scope="module")
def ageing_fleet(tmp_path_factory):
    """Return folder and true slopes of packs that lose 6 % in a year, with a spread of 2 %."""
    folder, rng = tmp_path_factory.mktemp("ageing_fleet"), np.random.default_rng(1)
    slopes = SLOPE_PER_YEAR + 0.02 * rng.standard_normal(PACKS)
    truth = -0.1 + slopes[:, None] * np.arange(DAYS) / 365.25
    estimates, variance = estimate_capacities(rng, truth, std=0.01, daily_throughput=1.0)
    ratio = np.exp(estimates)
    write_fleet(
        folder, BEGIN + 24 * np.arange(DAYS) + 23, capacity_ratio=ratio, capacity_ratio_std=ratio * np.sqrt(variance),
        capacity_first_std=FIRST_STD, charge_out_ah=3.0,
    )  # fmt: skip
    return folder, slopes


def test_95_percent_bands_contain_the_true_trend_and_capacity_of_95_percent_of_the_packs(ageing_fleet):
    folder, slopes = ageing_fleet
    packs = {row["pack"]: row for row in run_query(folder, "soh").records if row["pack"]}
    is_slope_inside = [
        packs[f"p{n}"]["percent_per_year_low"] < 100 * slope < packs[f"p{n}"]["percent_per_year_high"]
        for n, slope in enumerate(slopes)
    ]
    assert 0.93 < np.mean(is_slope_inside) < 0.98  # 95 %; its std with 400 packs is 1.1 %
    last_ratio = np.exp(-0.1 + slopes * (DAYS - 1) / 365.25)
    is_ratio_inside = [
        packs[f"p{n}"]["capacity_ratio_low"] < last_ratio[n] < packs[f"p{n}"]["capacity_ratio_high"]
        for n in range(PACKS)
    ]
    assert 0.93 < np.mean(is_ratio_inside) < 0.98


def test_mean_trend_of_a_type_and_its_spread_over_the_packs_are_found(ageing_fleet):
    (row,) = [row for row in run_query(ageing_fleet[0], "soh").records if not row["pack"]]
    assert (row["type"], row["packs"], row["days"]) == ("ncr18650 1s1p 3 Ah", PACKS, DAYS)
    assert row["percent_per_year_low"] < 100 * SLOPE_PER_YEAR < row["percent_per_year_high"]
    assert row["percent_per_year_high"] - row["percent_per_year_low"] < 1.0
    assert row["percent_per_year_spread"] == pytest.approx(2.0, abs=0.7)


def test_estimate_without_new_measurements_gives_no_trend(tmp_path):
    """The filter has learned the capacity once. Since then it has measured nothing, so that only the variance grows."""
    days = 60
    variance = 0.02**2 * np.ones(days)
    retained_variance = np.exp(-1.0 / AGED_SOC) ** 2
    for day in range(1, days):
        variance[day] = retained_variance * variance[day - 1] + (1.0 - retained_variance) * FIRST_STD**2
    ratio = 0.9 * np.ones((3, days))
    write_fleet(
        tmp_path, BEGIN + 24 * np.arange(days), capacity_ratio=ratio, capacity_ratio_std=ratio * np.sqrt(variance),
        capacity_first_std=FIRST_STD, charge_out_ah=3.0,
    )  # fmt: skip
    answer = run_query(tmp_path, "soh")
    assert (answer.rows, answer.notes[-1].partition(" on which")[0]) == ([], "no trend yet: it needs 7 days")


def test_outliers_are_found_except_those_with_a_large_uncertainty(tmp_path):
    rng = np.random.default_rng(2)
    packs = 1000
    capacity, std = 0.9 + 0.02 * rng.standard_normal((packs, 1)), np.full((packs, 1), 0.01)
    std[:300] = 0.08  # these packs have learned little, so that their estimates equal the cell file
    estimates = capacity + std * rng.standard_normal((packs, 1))
    estimates[:300] = 1.0
    r_s = np.exp(0.3 + 0.05 * rng.standard_normal((packs, 1)))
    estimates[500], estimates[501], r_s[502] = 0.7, 1.1, 2.5  # outliers
    estimates[10], std[10] = 0.7, 0.3  # as far off, but uncertain
    write_fleet(
        tmp_path, np.array([BEGIN]), capacity_ratio=estimates, capacity_ratio_std=std, capacity_first_std=FIRST_STD,
        r_s_ratio=r_s, r_s_ratio_std=0.02 * r_s, r_s_unlearned_s=10.0,
    )  # fmt: skip
    result = run_query(tmp_path, "outliers").records
    assert {(row["pack"], row["quantity"]) for row in result} == {
        ("p500", "capacity_ratio"), ("p501", "capacity_ratio"), ("p502", "r_s_ratio"),
    }  # fmt: skip
    assert [row["median_of_type"] for row in result if row["pack"] == "p500"] == [pytest.approx(0.9, abs=0.005)]
    assert [row["spread_of_type"] for row in result if row["pack"] == "p500"] == [pytest.approx(0.02, abs=0.01)]


def test_type_of_four_packs_has_no_outliers(tmp_path):
    estimates = np.array([[0.9], [0.9], [0.9], [0.2]])
    write_fleet(
        tmp_path, np.array([BEGIN]), capacity_ratio=estimates, capacity_ratio_std=0.01, capacity_first_std=FIRST_STD
    )
    assert run_query(tmp_path, "outliers").rows == []


def test_packs_whose_capacity_resistance_margin_or_suspects_get_worse_are_found_with_the_days_left(tmp_path):
    rng, days = np.random.default_rng(3), 60
    slopes = np.zeros(500)
    slopes[7] = -0.9  # reaches 0.8 from 0.9 in 48 days after two months
    truth = np.log(0.9) + slopes[:, None] * (np.arange(days) - days + 1) / 365.25
    estimates, variance = estimate_capacities(rng, truth, std=0.01, daily_throughput=1.0)
    r_s = 1.2 * np.exp(0.05 * rng.standard_normal((500, days)))
    r_s[8] *= np.exp(2.0 * (np.arange(days) - days + 1) / 365.25) * 1.3  # 1.56 now; 2.0 in 45 days
    margin = 0.3 + 0.05 * rng.standard_normal((500, days))
    margin[9] -= 0.27 * np.arange(days) / days  # 0.03 now; 0 in 7 days
    suspects = np.zeros((500, days), int)
    suspects[10, -4:] = InputFault.CAPACITY  # new
    suspects[11, :] = InputFault.OFFSET  # present from the beginning, and therefore not reported
    write_fleet(
        tmp_path, BEGIN + 24 * np.arange(days), capacity_ratio=np.exp(estimates), charge_out_ah=3.0,
        capacity_ratio_std=np.exp(estimates) * np.sqrt(variance), capacity_first_std=FIRST_STD, r_s_ratio=r_s,
        r_s_ratio_std=0.05 * r_s, r_s_unlearned_s=10.0, stability_margin_min=margin, suspects=suspects,
    )  # fmt: skip
    result = {row["pack"]: row for row in run_query(tmp_path, "failing").records}
    assert {pack: row["quantity"] for pack, row in result.items()} == {
        "p7": "capacity_ratio", "p8": "r_s_ratio", "p9": "stability_margin_min", "p10": "suspect: capacity",
    }  # fmt: skip
    assert result["p7"]["days_left_low"] < 48 < result["p7"]["days_left_high"]
    assert result["p8"]["days_left_low"] < 45 < result["p8"]["days_left_high"]
    assert result["p9"]["days_left_low"] < 7 < result["p9"]["days_left_high"]


@pytest.mark.parametrize(
    ("factor", "minimum", "maximum"),
    [(1.0, 0.94, 0.97), (0.5, 0.62, 0.8), (2.0, 0.99, 1.0)],
    ids=["correct band", "too narrow band", "too wide band"],
)
def test_coverage_of_soc_bands_is_estimated_without_the_true_soc(tmp_path, factor, minimum, maximum):
    columns = estimate_soc(np.random.default_rng(4), 300, 96)
    columns["soc_mean_std"] = factor * columns["soc_mean_std"]
    write_fleet(
        tmp_path, BEGIN + np.arange(96), capacity_ratio=1.0, capacity_ratio_std=1e-6, capacity_first_std=1e-6,
        current_offset_a=0.0, current_offset_std_a=1e-9, soc_capacity_correlation=0.0, soc_offset_correlation=0.0,
        capacity_offset_correlation=0.0, temperature_c=25.0, **columns,
    )  # fmt: skip
    result = run_query(tmp_path, "honest").records
    overall, groups = result[0], {(row["of"], row["which"]) for row in result[1:]}
    assert {("type", "ncr18650 1s1p 3 Ah"), ("temperature", "20 to 30 C"), ("age", "first day")} <= groups
    assert minimum < overall["within_2_std"] < maximum
    assert overall["low"] <= overall["within_2_std"] <= overall["high"]
    assert overall["high"] - overall["low"] < 0.1
    assert overall["std_should_be_times"] == pytest.approx(1.0 / factor, rel=0.2)


def test_silent_pack_is_reported_with_its_last_values(tmp_path):
    write(tmp_path, [make_hour("lives", BEGIN + n) for n in range(30)])
    write(tmp_path, [make_hour("stopped", BEGIN + n, soc=0.1 * n) for n in range(5)])
    (row,) = run_query(tmp_path, "silent", wall=lambda: 3600.0 * (BEGIN + 30)).records
    assert (row["pack"], row["hours_silent"], row["silent_since"]) == ("stopped", 25, "2025-11-24T05:00:00Z")
    assert row["soc"] == pytest.approx(0.4)


def test_duplicate_rows_count_once_before_and_after_a_merge(tmp_path):
    rows = [make_hour("a", BEGIN + n) for n in range(24)]
    write(tmp_path, rows)
    write(tmp_path, rows[5:9])
    assert select(tmp_path, "SELECT count(*), min(time) FROM hours").rows == [(24, "2025-11-24T00:00:00Z")]
    (day,) = tmp_path.glob("date=*")
    compact(day)
    write(tmp_path, [make_hour("a", BEGIN + 24)])
    assert select(tmp_path, "SELECT count(*) AS n FROM hours").rows == [(25,)]
    assert select(tmp_path, "SELECT count(*) AS n FROM hours", days=1).rows == [(1,)]


def test_files_that_lack_columns_are_read_unless_pack_and_hour_are_missing(tmp_path):
    write(tmp_path, [make_hour("a", BEGIN)])
    (file,) = tmp_path.glob("*/*.parquet")
    pq.write_table(pq.read_table(file).drop_columns(["capacity_first_std", "r_s_ratio"]), file)
    for name in QUERIES:
        assert run_query(tmp_path, name, wall=lambda: 3600.0 * BEGIN).rows == []
    pq.write_table(pa.table({"x": [1]}), file)
    with pytest.raises(UserError, match="lack the columns pack and hour"):
        run_query(tmp_path, "soh")


def test_invalid_arguments_are_reported(tmp_path):
    with pytest.raises(UserError, match="no such query; there are soh, outliers"):
        run_query(tmp_path, "nonsense")
    with pytest.raises(UserError, match="no such folder; `bms-estimator fleet collect"):
        run_query(tmp_path / "none", "soh")
    with pytest.raises(UserError, match="no hours yet"):
        run_query(tmp_path, "soh")
    write(tmp_path, [make_hour("a", BEGIN)])
    for query, reason in (
        ("SELEC 1", "syntax error"), ("SELECT * FROM read_csv('/etc/passwd')", "disabled"),
        ("COPY hours TO 'x.csv'", "only SELECT"), ("SELECT nothing FROM hours", "nothing"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=f"sql: .*{reason}"):
            select(tmp_path, query)
    (file,) = tmp_path.glob("*/*.parquet")
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(UserError, match=r"batch-.*\.parquet: an incomplete Parquet file"):
        run_query(tmp_path, "soh")


def test_schema_has_the_queried_columns():
    assert {"pack", "hour", "soc", "suspects"} < set(SCHEMA.names)
