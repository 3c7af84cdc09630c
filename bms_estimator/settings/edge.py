"""``[edge]``: sending of raw samples to a fleet's server, in blocks."""

from typing import Annotated, ClassVar

from pydantic import Field

from bms_estimator.settings.broker import BrokerSettings


class EdgeSettings(BrokerSettings):
    """Edge of a fleet: destination and storage of raw samples, see docs/fleet/edge.md."""

    section: ClassVar[str] = "edge"

    block_s: Annotated[float, Field(ge=1.0, le=3600.0)] = Field(
        default=60.0, description="duration of a block; a kill loses at most one"
    )
    store_mib: Annotated[float, Field(ge=0.1, le=100_000.0)] = Field(
        default=100.0,
        description="size limit of stored blocks, 100 days at 1 Hz; beyond it the oldest is dropped",
    )
