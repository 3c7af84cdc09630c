"""Summary of an hour's blocks as one row.

The row depends only on the stream: a worker that processes the blocks again computes an equal row.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.edge.block import Block
from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.estimator.identified_parameters import current_offset, relative_capacity, relative_series_resistance
from bms_estimator.fleet.hour_row import HOUR_S, Hour
from bms_estimator.fleet.worker.block_order import last_sample_s
from bms_estimator.kernels.accumulators.hour import HOUR_SUMS, HOURLY_FIELDS, accumulate_hour
from bms_estimator.kernels.kalman_filter.equivalent_circuit import R_S, R_TL, R_TS, TAU_TL, TAU_TS
from bms_estimator.kernels.kalman_filter.hypotheses import weakest_cell_soc_std
from bms_estimator.kernels.kalman_filter.records import LN_Q, OFFSET, SOC
from bms_estimator.settings.pack import PackSettings

__all__ = ["HOUR_S", "HOUR_SUMS", "Hour", "add", "begin", "hour_of", "row"]

REST_C = 0.01
"""Maximum current of a resting pack, as a C-rate [1/h]."""

SIGNIFICANT_STDS = 3.0
"""Number of std by which the deviation of a cell is reduced before the weakest cell, and the cell with the highest resistance,
are selected, so that an uncertain estimate does not select its cell."""

Sums = NDArray[np.void]
"""Shape (1,), dtype ``HOUR_SUMS``; all zero before the first block."""


def hour_of(block: Block) -> int:
    """Return the hour of a block on the edge's clock at its last sample [hours since 1970].

    A block whose last timestamp is not finite belongs to the hour in which its store was created.
    """
    return int(last_sample_s(block) // HOUR_S)


def begin(sums: Sums, record: np.void) -> None:
    """Begin an hour: reset the sums and counts, but not the last sample.

    Args:
        sums: Updated in place.
        record: The pack's record of dtype ``ESTIMATOR_STATE``.
    """
    for name in HOURLY_FIELDS:
        sums[name] = 0
    sums["outliers_before"], sums["searches_before"] = record["counters"]["gated"], record["filter"]["reopened"]


def add(sums: Sums, trace: TraceBlock, samples: int, store_ns: int, estimator: Estimator) -> None:
    """Add samples to the sums of the hour.

    Args:
        sums: Updated in place.
        trace: Estimates of the samples.
        samples: Number of samples, of which the estimator may have rejected some.
        store_ns: Creation time of the edge's store [ns since 1970].
        estimator: Estimator of the pack's type; only its settings are read.
    """
    gap_s = float(estimator.settings[0]["gap_s"])
    accumulate_hour(sums, trace, int(sums["store"][0]) != store_ns, gap_s, rest_current_a(estimator))
    sums["store"] = store_ns
    sums["dropped"] += samples - trace.size


def rest_current_a(estimator: Estimator) -> float:
    """Return the maximum current of a resting pack [A]."""
    return REST_C * float(estimator.settings[0]["capacity_as"]) / HOUR_S


def cell_fields(cells: CellDeviations | None) -> dict[str, float]:
    """Return the fields of a row about single cells; empty without an estimate."""
    if cells is None:
        return {}
    weak = int(np.argmin(cells.soc_deviation + SIGNIFICANT_STDS * cells.soc_deviation_std))
    small = int(np.argmin(cells.capacity_ratio))
    resistive = int(np.argmax(cells.resistance_ratio - SIGNIFICANT_STDS * cells.resistance_ratio_std))
    leaking = int(np.argmax(cells.self_discharge_a / cells.self_discharge_std_a))
    return {
        "weakest_cell": weak + 1,
        "weakest_cell_soc_deviation": float(cells.soc_deviation[weak]),
        "weakest_cell_soc_deviation_std": float(cells.soc_deviation_std[weak]),
        "weakest_cell_resistance_ratio": float(cells.resistance_ratio[weak]),
        "cell_soc_spread": float(np.ptp(cells.soc_deviation)),
        "smallest_cell": small + 1,
        "smallest_cell_capacity_ratio": float(cells.capacity_ratio[small]),
        "resistive_cell": resistive + 1,
        "resistive_cell_ratio": float(cells.resistance_ratio[resistive]),
        "resistive_cell_ratio_std": float(cells.resistance_ratio_std[resistive]),
        "self_discharge_cell": leaking + 1,
        "self_discharge_a": float(cells.self_discharge_a[leaking]),
        "self_discharge_std_a": float(cells.self_discharge_std_a[leaking]),
    }


def row(pack: PackSettings, hour: int, sums: Sums, estimator: Estimator) -> Hour:
    """Return the row of a finished hour.

    Args:
        pack: Settings of the pack.
        hour: Hours since 1970.
        sums: Sums of the hour; read only.
        estimator: Estimator with the pack's state at the hour's end; read only.
    """
    hour_sums, record = sums[0], estimator.record[0]
    unknown = dict.fromkeys(Hour.model_fields)
    values = (
        unknown
        | _counts(hour_sums, record)
        | _measurements(hour_sums)
        | _observer_values(record)
        | _filter_values(estimator)
    )
    identity = {"pack": pack.name, "cell": pack.cell, "series": pack.series, "parallel": pack.parallel}
    return Hour.model_validate(
        {name: _finite(value) for name, value in values.items()}
        | identity
        | {"hour": hour, "capacity_ah": estimator.cell.capacity_ah}
    )


def _counts(hour_sums: np.void, record: np.void) -> dict[str, object]:
    """Return counts, durations and totals."""
    return {
        "samples": int(hour_sums["samples"]),
        "dropped": int(hour_sums["dropped"]),
        "outliers": int(record["counters"]["gated"] - hour_sums["outliers_before"]),
        "searches": int(record["filter"]["reopened"] - hour_sums["searches_before"]),
        "gaps": int(hour_sums["gaps"]),
        "lost_blocks": int(hour_sums["lost_blocks"]),
        "seen_s": float(hour_sums["seen_s"]),
        "rest_s": float(hour_sums["rest_s"]),
        "charge_out_ah": float(hour_sums["out_as"]) / HOUR_S,
        "charge_in_ah": float(hour_sums["in_as"]) / HOUR_S,
        "energy_out_wh": float(hour_sums["out_ws"]) / HOUR_S,
        "energy_in_wh": float(hour_sums["in_ws"]) / HOUR_S,
        "suspects": int(record["checks"]["suspects"]),
    }


def _measurements(hour_sums: np.void) -> dict[str, object]:
    """Return means and extremes; empty if no sample was accepted."""
    values: dict[str, object] = {}
    for quantity, unit, count_field in (
        ("voltage", "v", "samples"),
        ("current", "a", "samples"),
        ("temperature", "c", "temperatures"),
    ):
        count = int(hour_sums[count_field])
        if count:
            values[f"{quantity}_{unit}"] = float(hour_sums[f"sum_{unit}"]) / count
            values[f"{quantity}_min_{unit}"] = float(hour_sums[f"min_{unit}"])
            values[f"{quantity}_max_{unit}"] = float(hour_sums[f"max_{unit}"])
    if hour_sums["samples"] and math.isfinite(hour_sums["min_margin"]):
        values["stability_margin_min"] = float(hour_sums["min_margin"])
    if hour_sums["innovations"]:
        values["innovation_rms_v"] = math.sqrt(hour_sums["sum_innovation_v2"] / hour_sums["innovations"])
    return values


def _observer_values(record: np.void) -> dict[str, object]:
    """Return the observer's values; empty before the pack's first sample."""
    observer = record["observer"]
    return {name: float(observer[name]) for name in ("soc", "delta_1", "delta_2")} if observer["started"] else {}


class _Element(NamedTuple):
    name: str
    unit: str
    position: int


_ELEMENTS = (
    _Element("r_s", "ohm", R_S),
    _Element("r_ts", "ohm", R_TS),
    _Element("tau_ts", "s", TAU_TS),
    _Element("r_tl", "ohm", R_TL),
    _Element("tau_tl", "s", TAU_TL),
)


def _filter_values(estimator: Estimator) -> dict[str, object]:
    """Return the filter's values; empty without a filter and before its first sample."""
    record, settings = estimator.record[0], estimator.settings_record[0]
    filter_state = record["filter"]
    if not (estimator.has_filter and filter_state["started"]):
        return {}
    capacity, offset, r_s = (
        relative_capacity(record),
        current_offset(record),
        relative_series_resistance(record, settings, estimator.cell_file_settings),
    )
    values: dict[str, object] = {
        "soc_std": float(weakest_cell_soc_std(filter_state, settings["filter"])),
        "soc_mean_std": float(filter_state["soc_std"]),
        "capacity_ratio": capacity.value,
        "capacity_ratio_std": capacity.std,
        "capacity_first_std": float(settings["filter"]["capacity_std"]),
        "current_offset_a": offset.value,
        "current_offset_std_a": offset.std,
        "r_s_ratio": r_s.value,
        "r_s_ratio_std": r_s.std,
        "r_s_unlearned_s": r_s.age_s,
    }
    covariance = filter_state["covariance"][filter_state["best"]]
    for name, (j, k) in _CORRELATIONS.items():
        values[name] = _correlation(covariance, j, k)
    for element in _ELEMENTS:
        value = float(record["elements"]["value"][element.position])
        values[f"{element.name}_{element.unit}"] = value
        variance = float(record["elements"]["ln_variance"][element.position])
        values[f"{element.name}_std_{element.unit}"] = value * math.sqrt(variance)
    return values


_CORRELATIONS = {
    "soc_capacity_correlation": (SOC, LN_Q),
    "soc_offset_correlation": (SOC, OFFSET),
    "capacity_offset_correlation": (LN_Q, OFFSET),
}


def _correlation(covariance: NDArray[np.float64], j: int, k: int) -> float:
    """Return the correlation of states ``j`` and ``k``; 0 if one of them is fixed."""
    variances = float(covariance[j, j] * covariance[k, k])
    return float(covariance[j, k]) / math.sqrt(variances) if variances > 0.0 else 0.0


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
