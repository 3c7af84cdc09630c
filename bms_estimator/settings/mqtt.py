"""``[mqtt]``: broker, topics and allowed commands; ``[home_assistant]``: entities of a pack in Home Assistant."""

from typing import Annotated, Literal

from pydantic import Field

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.broker import BrokerSettings

Topic = Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")]
"""MQTT topic without wildcards and spaces, and without a slash at either end."""


class HomeAssistantSettings(Strict):
    """Discovery by Home Assistant over the MQTT broker; see docs/pack/home-assistant.md."""

    enabled: bool = Field(
        default=True, description="false: no discovery; the pack's device is removed from Home Assistant"
    )
    discovery_prefix: Topic = Field(
        default="homeassistant", description="discovery prefix of Home Assistant's MQTT integration"
    )
    status_topic: Topic = Field(default="homeassistant/status", description="topic of Home Assistant's birth message")
    name: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="name of the pack's device; default: pack.name"
    )
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive", description="direction of positive current and power in Home Assistant"
    )
    names: dict[str, Annotated[str, Field(min_length=1)]] = Field(
        default={},
        description='names of entities in place of the default names, such as energy_in_kwh = "Energie geladen"',
    )


Command = Literal["set_soc", "current_zero", "acknowledge_alarm", "publish_rate", "forget_pack"]
"""Name of a request that changes the estimator or the service."""


class MqttSettings(BrokerSettings):
    """MQTT broker, and the commands that clients may send."""

    base_topic: Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")] = Field(
        default="bms", description="prefix of all topics; must not contain +, # or spaces, nor begin or end with /"
    )
    profile: Literal["venus-os"] | None = Field(
        default=None,
        description="also publish the battery for a Victron GX device, in the format of dbus-mqtt-battery, on the topic venus below the topic of the pack",
    )
    commands: tuple[Command, ...] = Field(default=(), description="commands that clients may send; default: none")
