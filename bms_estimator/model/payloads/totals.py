"""Totals over restarts, part of the topic ``health``."""

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload


class Totals(Payload):
    """Totals over restarts; those after the last checkpoint before a kill are missing."""

    since: str = Field(description="start of counting, ISO 8601, UTC")
    crashes: int = Field(description="starts after a run that did not end cleanly (fault, kill, power failure)")
    samples: dict[str, int] = Field(description="accepted and dropped samples by kind")
    unseen_s: float = Field(description="total time in gaps and between runs, if the length was known [s]")
    charge_out_ah: float = Field(default=0.0, description="charge discharged at the terminals [Ah]")
    charge_in_ah: float = Field(default=0.0, description="charge charged at the terminals [Ah]")
    energy_out_kwh: float = Field(default=0.0, description="energy discharged at the terminals [kWh]")
    energy_in_kwh: float = Field(default=0.0, description="energy charged at the terminals [kWh]")
