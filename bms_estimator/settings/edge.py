"""``[edge]``: sending of raw samples to a fleet's server, in blocks."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.mqtt import validate_broker_urls


class EdgeSettings(Strict):
    """Edge of a fleet: destination and storage of raw samples, see docs/fleet/edge.md."""

    model_config = ConfigDict(hide_input_in_errors=True)

    url: Annotated[str | tuple[str, ...], AfterValidator(validate_broker_urls)] = Field(
        default="mqtt://localhost:1883", description="URL of the fleet's server, or a list, as mqtt.url"
    )
    username: str | None = Field(default=None, description="as mqtt.username")
    password_file: Path | None = Field(
        default=None, description="file with the password or the edge's token; as mqtt.password_file"
    )
    ca_file: Path | None = Field(default=None, description="as mqtt.ca_file")
    cert_file: Path | None = Field(default=None, description="as mqtt.cert_file")
    key_file: Path | None = Field(default=None, description="as mqtt.key_file")
    block_s: Annotated[float, Field(ge=1.0, le=3600.0)] = Field(
        default=60.0, description="duration of a block; a kill loses at most one"
    )
    store_mib: Annotated[float, Field(ge=0.1, le=100_000.0)] = Field(
        default=100.0,
        description="size limit of stored blocks, 100 days at 1 Hz; beyond it the oldest is dropped",
    )
