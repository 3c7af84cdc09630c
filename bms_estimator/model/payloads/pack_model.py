"""State of the fit of the pack's model, part of the topic ``health``."""

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload


class FitReport(Payload):
    """Change of the estimates by a fit of the pack's model."""

    soc_before: float = Field(description="SOC before the fit was adopted, 0..1")
    soc_after: float = Field(description="SOC after the fit was adopted, 0..1")
    capacity_before_ah: float = Field(description="capacity before the fit was adopted [Ah]")
    capacity_after_ah: float = Field(description="capacity after the fit was adopted [Ah]")


class PackModelHealth(Payload):
    """Fit of the pack's model to its history; counters since start."""

    fits: int = Field(description="adopted fits")
    late: int = Field(description="fits that were not done when due and were adopted at a later sample")
    failed: int = Field(description="fits that ended with an error, which the log describes")
    changes: int = Field(
        description="fits that changed the SOC, or the capacity relative to the rated one, by more than 0.01"
    )
    rows: int = Field(description="rows of the history")
    segments: int = Field(description="uninterrupted measurements in the history")
    history_days: float = Field(
        description="time from the first to the last row, without gaps of unknown duration [days]"
    )
    capacity_ah: float | None = Field(description="learned capacity of the pack [Ah]; null before the first sample")
    capacity_std_ah: float | None = Field(description="standard deviation of capacity_ah [Ah]")
    last_fit: str | None = Field(description="time at which the last fit ended, ISO 8601, UTC; null: none since start")
    last_fit_s: float | None = Field(description="duration of the last fit [s]")
    change: FitReport | None = Field(description="the last of the changes; null: none since start")
