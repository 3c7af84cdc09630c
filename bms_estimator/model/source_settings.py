"""``[source]``: where samples come from when it is no serial board. One model for each ``kind``, and a line here."""

from typing import Annotated

from pydantic import Field, TypeAdapter

from bms_estimator.model.linux_source import LinuxSource
from bms_estimator.model.mqtt_source import MqttSource

SourceSettings = Annotated[MqttSource | LinuxSource, Field(discriminator="kind")]
SOURCE: TypeAdapter[MqttSource | LinuxSource] = TypeAdapter(SourceSettings)
