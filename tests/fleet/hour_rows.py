"""Hour rows of simulated packs, as the collector stores them, with known true values."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.queries.duckdb_queries import AGED_SOC, CHARGE_ERROR
from bms_estimator.fleet.queries.parquet_files import SCHEMA

BEGIN = 490_000 // 24 * 24
"""First hour of the rows, at midnight [hours since 1970]."""
FIRST_STD = 0.08
"""Initial standard deviation of ln(capacity)."""
EMPTY_ROW = dict.fromkeys(Hour.model_fields) | {
    "cell": "ncr18650", "series": 1, "parallel": 1, "capacity_ah": 3.0, "samples": 3600, "dropped": 0, "outliers": 0,
    "searches": 0, "gaps": 0, "lost_blocks": 0, "seen_s": 3600.0, "rest_s": 0.0, "charge_out_ah": 0.0,
    "charge_in_ah": 0.0, "energy_out_wh": 0.0, "energy_in_wh": 0.0, "suspects": 0,
}  # fmt: skip


def make_hour(pack: str, hour: int, **values: Any) -> Hour:
    """Return a pack's row of an hour, with no values but ``values`` and those of ``EMPTY_ROW``."""
    return Hour.model_validate(EMPTY_ROW | {"pack": pack, "hour": hour} | values)


def write_fleet(folder: Path, hours: np.ndarray, names: list[str] | None = None, **columns: Any) -> None:
    """Write one row for each pack and hour, all to one Parquet file.

    Args:
        folder: Folder that the queries read.
        hours: Hours of the rows, shape (hours,).
        names: Names of the packs; default: p0, p1 ...
        columns: Values, each broadcast to (packs, hours). At least one of them has two dimensions.
    """
    packs = len(names) if names else max(np.shape(column)[0] for column in columns.values() if np.ndim(column) == 2)
    names = names or [f"p{n}" for n in range(packs)]
    values = EMPTY_ROW | columns | {"pack": np.array(names)[:, None], "hour": hours}
    arrays = {
        name: None if value is None else np.broadcast_to(value, (packs, hours.size)).ravel()
        for name, value in values.items()
    }
    row_count = packs * hours.size
    table_columns = [
        pa.nulls(row_count, field.type) if arrays[field.name] is None else pa.array(arrays[field.name], field.type)
        for field in SCHEMA
    ]
    file = folder / "date=2025-11-24" / "day-made-up.parquet"
    file.parent.mkdir(parents=True)
    pq.write_table(pa.table(table_columns, schema=SCHEMA), file)


def estimate_capacities(
    rng: np.random.Generator, truth: np.ndarray, std: float, daily_throughput: float
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the capacity as the filter does, from one measurement of ln(capacity) a day.

    Args:
        rng: Random generator of the measurements.
        truth: True ln(capacity), shape (packs, days).
        std: Standard deviation of one measurement.
        daily_throughput: Charge moved each day [capacities].

    Returns:
        Estimate of ln(capacity) and its variance, shape (packs, days).
    """
    retained = np.exp(-daily_throughput / AGED_SOC)
    x, p = np.zeros(truth.shape[0]), np.full(truth.shape[0], FIRST_STD**2)
    estimates, variance = np.empty(truth.shape), np.empty(truth.shape)
    for day in range(truth.shape[1]):
        if day:  # aging since the day before
            x, p = retained * x, retained**2 * p + (1.0 - retained**2) * FIRST_STD**2
        gain = p / (p + std**2)
        x = x + gain * (truth[:, day] + std * rng.standard_normal(x.size) - x)
        p = p - gain * p
        estimates[:, day], variance[:, day] = x, p
    return estimates, variance


def estimate_soc(rng: np.random.Generator, packs: int, hours: int) -> dict[str, np.ndarray]:
    """Estimate SOC with a consistent filter. The voltage tells little of the SOC in the middle, and more near the ends.

    The charge of each hour is counted with the random error ``CHARGE_ERROR``.

    Returns:
        Columns of shape (packs, hours), for a capacity of 3 Ah.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi, packs)
    moved = 0.06 * np.sin(phase[:, None] + np.arange(hours) * 2.0 * np.pi / 24.0)  # discharged in each hour
    counted_soc = 0.5 - np.cumsum(moved, axis=1)
    truth = counted_soc + np.cumsum(CHARGE_ERROR * np.sqrt(np.abs(moved)) * rng.standard_normal(moved.shape), axis=1)
    x, p = 0.5 + 0.2 * rng.standard_normal(packs), np.full(packs, 0.2**2)
    initial_soc = truth[:, 0] + moved[:, 0]
    x = x + (initial_soc - 0.5)
    soc, std = np.empty(moved.shape), np.empty(moved.shape)
    for hour in range(hours):
        x, p = x - moved[:, hour], p + CHARGE_ERROR**2 * np.abs(moved[:, hour])
        # standard deviation of an SOC that is measured by the voltage
        measured_std = 0.001 + 0.5 * np.exp(-(((counted_soc[:, hour] - 0.5) / 0.08) ** 2))
        gain = p / (p + measured_std**2)
        x = x + gain * (truth[:, hour] + measured_std * rng.standard_normal(packs) - x)
        p = p - gain * p
        soc[:, hour], std[:, hour] = x, np.sqrt(p)
    return {
        "soc": soc,
        "soc_mean_std": std,
        "charge_out_ah": 3.0 * np.maximum(moved, 0.0),
        "charge_in_ah": 3.0 * np.maximum(-moved, 0.0),
    }
