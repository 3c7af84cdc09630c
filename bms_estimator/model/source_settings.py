"""``[source]``: where samples come from when it is no serial board. One model for each ``kind``, and a line here."""

from typing import Annotated

from pydantic import Field, TypeAdapter

from bms_estimator.model.ble_settings import BleSource
from bms_estimator.model.can_settings import CanSource
from bms_estimator.model.linux_settings import LinuxSource
from bms_estimator.model.modbus_settings import ModbusSource
from bms_estimator.model.mqtt_source_settings import MqttSource

SourceSettings = Annotated[MqttSource | LinuxSource | ModbusSource | CanSource | BleSource, Field(discriminator="kind")]
SOURCE: TypeAdapter[SourceSettings] = TypeAdapter(SourceSettings)
