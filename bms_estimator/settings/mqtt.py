"""``[mqtt]``: broker, topics and allowed commands."""

from typing import Annotated, Literal

from pydantic import Field

from bms_estimator.settings.broker import BrokerSettings

Command = Literal["set_soc", "current_zero", "acknowledge_alarm", "publish_rate", "forget_pack"]
"""Name of a request that changes the estimator or the service."""


class MqttSettings(BrokerSettings):
    """MQTT broker, and the commands that clients may send."""

    base_topic: Annotated[str, Field(pattern=r"^[^+#\s/]([^+#\s]*[^+#\s/])?$")] = Field(
        default="bms", description="prefix of all topics; must not contain +, # or spaces, nor begin or end with /"
    )
    profile: Literal["venus-os"] | None = Field(
        default=None,
        description="also publish the battery for a Victron GX device on the topic venus below that of the pack, as dbus-mqtt-battery reads it",
    )
    commands: tuple[Command, ...] = Field(default=(), description="commands that clients may send; default: none")
