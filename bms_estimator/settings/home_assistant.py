"""``[home_assistant]``: entities of a pack in Home Assistant."""

from typing import Annotated, Literal

from pydantic import Field

from bms_estimator.model.config_file import Strict

Topic = Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")]
"""MQTT topic without wildcards and spaces, and without a slash at either end."""


class HomeAssistantSettings(Strict):
    """Home Assistant discovery over the broker, docs/pack/home-assistant.md."""

    enabled: bool = Field(default=True, description="false: no discovery; an existing device is removed")
    discovery_prefix: Topic = Field(
        default="homeassistant", description="discovery prefix of Home Assistant's MQTT integration"
    )
    status_topic: Topic = Field(default="homeassistant/status", description="topic of Home Assistant's birth message")
    name: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="name of the device; default: pack.name"
    )
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive", description="direction of positive current and power in Home Assistant"
    )
    names: dict[str, Annotated[str, Field(min_length=1)]] = Field(
        default={}, description='names of entities, such as energy_in_kwh = "Energie geladen"'
    )
