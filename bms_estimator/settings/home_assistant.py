"""Settings of a pack in Home Assistant."""

from typing import Annotated, Literal

from pydantic import Field

from bms_estimator.model.config_file import Strict

Topic = Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")]
"""No +, # or spaces, no / at either end."""


class HomeAssistantSettings(Strict):
    """Home Assistant discovery over the broker, docs/pack/home-assistant.md."""

    enabled: bool = Field(default=True, description="false: it is told nothing, and a device that it has goes")
    discovery_prefix: Topic = Field(default="homeassistant", description="as in its MQTT integration")
    status_topic: Topic = Field(default="homeassistant/status", description="where it says that it has started")
    name: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="of the device; pack.name when left out"
    )
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive", description="what it shows of current and power as positive"
    )
    names: dict[str, Annotated[str, Field(min_length=1)]] = Field(
        default={}, description='of entities in your language, such as energy_in_kwh = "Energie geladen"'
    )
