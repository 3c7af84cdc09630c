"""Hours of packs made up, with a truth that is known."""

from typing import Any

from bms_estimator.fleet.hour_row import Hour

NOTHING = dict.fromkeys(Hour.model_fields) | {
    "cell": "ncr18650", "series": 1, "parallel": 1, "capacity_ah": 3.0, "samples": 3600, "dropped": 0, "outliers": 0,
    "searches": 0, "gaps": 0, "lost_blocks": 0, "seen_s": 3600.0, "rest_s": 0.0, "charge_out_ah": 0.0,
    "charge_in_ah": 0.0, "energy_out_wh": 0.0, "energy_in_wh": 0.0, "suspects": 0,
}  # fmt: skip


def an_hour(pack: str, hour: int, **values: Any) -> Hour:
    """An hour of which only ``values`` are known."""
    return Hour.model_validate(NOTHING | {"pack": pack, "hour": hour} | values)
