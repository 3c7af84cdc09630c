"""Hours of packs made up, with a truth that is known."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.queries.duckdb_queries import AGED_SOC, CHARGE_ERROR
from bms_estimator.fleet.queries.parquet_files import SCHEMA

BEGIN = 490_000 // 24 * 24
"""The hour at which they begin, a midnight."""
FIRST_STD = 0.08
"""Of the capacity."""
NOTHING = dict.fromkeys(Hour.model_fields) | {
    "cell": "ncr18650", "series": 1, "parallel": 1, "capacity_ah": 3.0, "samples": 3600, "dropped": 0, "outliers": 0,
    "searches": 0, "gaps": 0, "lost_blocks": 0, "seen_s": 3600.0, "rest_s": 0.0, "charge_out_ah": 0.0,
    "charge_in_ah": 0.0, "energy_out_wh": 0.0, "energy_in_wh": 0.0, "suspects": 0,
}  # fmt: skip


def an_hour(pack: str, hour: int, **values: Any) -> Hour:
    """An hour of which only ``values`` are known."""
    return Hour.model_validate(NOTHING | {"pack": pack, "hour": hour} | values)


def write_fleet(folder: Path, hours: np.ndarray, names: list[str] | None = None, **columns: Any) -> None:
    """Rows of packs by hours, in one file: each of ``columns`` can be spread to (packs, hours).

    Args:
        folder: Where ``questions`` reads.
        hours: Shape (hours,), of the rows.
        names: Of the packs; else p0, p1 ...
        columns: The packs' number stands in the shape of one of them.
    """
    packs = len(names) if names else max(np.shape(column)[0] for column in columns.values() if np.ndim(column) == 2)
    names = names or [f"p{n}" for n in range(packs)]
    spread = NOTHING | columns | {"pack": np.array(names)[:, None], "hour": hours}
    arrays = {
        name: None if value is None else np.broadcast_to(value, (packs, hours.size)).ravel()
        for name, value in spread.items()
    }
    size = packs * hours.size
    rows = [
        pa.nulls(size, field.type) if arrays[field.name] is None else pa.array(arrays[field.name], field.type)
        for field in SCHEMA
    ]
    file = folder / "date=2025-11-24" / "day-made-up.parquet"
    file.parent.mkdir(parents=True)
    pq.write_table(pa.table(rows, schema=SCHEMA), file)


def capacities(
    rng: np.random.Generator, truth: np.ndarray, std: float, through: float
) -> tuple[np.ndarray, np.ndarray]:
    """What a filter as ours makes of one measurement a day of ln(capacity), with ``std``.

    Args:
        rng: Of the measurements.
        truth: Shape (packs, days), ln.
        std: Of one measurement.
        through: Charge moved each day, of the capacity.

    Returns:
        Estimate of ln(capacity) and its variance, shape (packs, days).
    """
    kept = np.exp(-through / AGED_SOC)
    x, p = np.zeros(truth.shape[0]), np.full(truth.shape[0], FIRST_STD**2)
    found, variance = np.empty(truth.shape), np.empty(truth.shape)
    for day in range(truth.shape[1]):
        if day:
            x, p = kept * x, kept**2 * p + (1.0 - kept**2) * FIRST_STD**2
        gain = p / (p + std**2)
        x = x + gain * (truth[:, day] + std * rng.standard_normal(x.size) - x)
        p = p - gain * p
        found[:, day], variance[:, day] = x, p
    return found, variance


def states_of_charge(rng: np.random.Generator, packs: int, hours: int) -> dict[str, np.ndarray]:
    """SOC by a filter that is right: charge counted with ``CHARGE_ERROR``, voltage that tells much only near the ends.

    Returns:
        Columns of shape (packs, hours), of a capacity of 3 Ah.
    """
    phase = rng.uniform(0.0, 2.0 * np.pi, packs)
    moved = 0.06 * np.sin(phase[:, None] + np.arange(hours) * 2.0 * np.pi / 24.0)  # out of the pack, in each hour
    shown = 0.5 - np.cumsum(moved, axis=1)
    truth = shown + np.cumsum(CHARGE_ERROR * np.sqrt(np.abs(moved)) * rng.standard_normal(moved.shape), axis=1)
    x, p = 0.5 + 0.2 * rng.standard_normal(packs), np.full(packs, 0.2**2)
    error0 = truth[:, 0] + moved[:, 0] - 0.5  # where it really began
    x = x + error0
    soc, std = np.empty(moved.shape), np.empty(moved.shape)
    for hour in range(hours):
        x, p = x - moved[:, hour], p + CHARGE_ERROR**2 * np.abs(moved[:, hour])
        seen = 0.001 + 0.5 * np.exp(-(((shown[:, hour] - 0.5) / 0.08) ** 2))  # std of what the voltage says
        gain = p / (p + seen**2)
        x = x + gain * (truth[:, hour] + seen * rng.standard_normal(packs) - x)
        p = p - gain * p
        soc[:, hour], std[:, hour] = x, np.sqrt(p)
    return {
        "soc": soc,
        "soc_mean_std": std,
        "charge_out_ah": 3.0 * np.maximum(moved, 0.0),
        "charge_in_ah": 3.0 * np.maximum(-moved, 0.0),
    }
