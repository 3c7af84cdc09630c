"""``[edge]``: sending of raw samples to a fleet's server, in blocks."""

from typing import Annotated, ClassVar

from pydantic import Field

from bms_estimator.settings.broker import BrokerSettings, BrokerUrls


class EdgeSettings(BrokerSettings):
    """Edge of a fleet: fleet server to which raw samples are sent, and their storage; see docs/fleet/edge.md."""

    section: ClassVar[str] = "edge"

    url: BrokerUrls = Field(
        default="mqtt://localhost:1883",
        description="URL of the fleet server, mqtt://host:port or, with TLS, mqtts://host:port; or a list of URLs to try in turn",
    )
    block_s: Annotated[float, Field(ge=1.0, le=3600.0)] = Field(
        default=60.0,
        description="duration of a block of samples, which is stored and sent as one message; a killed process loses at most one block",
    )
    store_mib: Annotated[float, Field(ge=0.1, le=100_000.0)] = Field(
        default=100.0,
        description="maximum size of the stored blocks [MiB]; the default holds 100 days at 1 Hz. A full store drops its oldest block",
    )
    cells: bool = Field(
        default=False,
        description="send the voltages of the single cells too, if the source delivers them; upgrade all workers first, because "
        "earlier ones reject these blocks",
    )
