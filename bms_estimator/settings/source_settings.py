"""``[source]``: where samples come from when it is no serial board. One model for each ``kind``, and a line here."""

from typing import Annotated

from pydantic import Field, TypeAdapter

from bms_estimator.settings.ble_source import BleSource
from bms_estimator.settings.can_source import CanSource
from bms_estimator.settings.linux_source import LinuxSource
from bms_estimator.settings.modbus_source import ModbusSource
from bms_estimator.settings.mqtt_source import MqttSource

SourceSettings = Annotated[MqttSource | LinuxSource | ModbusSource | CanSource | BleSource, Field(discriminator="kind")]
SOURCE: TypeAdapter[SourceSettings] = TypeAdapter(SourceSettings)
