"""Which dialect ``sensor.protocol`` asks for."""

from collections.abc import Callable, Mapping

from bms_estimator.protocols.base.device_protocol import DeviceProtocol
from bms_estimator.protocols.devices.daly import DalyDialect
from bms_estimator.protocols.devices.jbd import JbdDialect
from bms_estimator.protocols.devices.jk import JkDialect
from bms_estimator.protocols.devices.junctek import JunctekDialect
from bms_estimator.protocols.devices.pylontech import PylontechDialect
from bms_estimator.protocols.devices.text import TextDialect
from bms_estimator.protocols.devices.vedirect import VeDirectDialect
from bms_estimator.settings.sensor import SensorSettings


def _board(sensor: SensorSettings) -> DeviceProtocol:
    """Of the firmware, whose frames a kernel decodes: who has another device need not load any."""
    from bms_estimator.protocols.firmware.protocol import BoardDialect  # noqa: PLC0415 - as said above

    return BoardDialect(current_sign=sensor.current_sign, rate_hz=sensor.sample_rate_hz)


DIALECTS: Mapping[str, Callable[[SensorSettings], DeviceProtocol]] = {
    "binary": _board,
    "text": lambda sensor: TextDialect(current_sign=sensor.current_sign),
    "vedirect": lambda sensor: VeDirectDialect(current_sign=sensor.current_sign),
    "junctek": lambda sensor: JunctekDialect(current_sign=sensor.current_sign),
    "pylontech": lambda sensor: PylontechDialect(current_sign=sensor.current_sign),
    "jbd": lambda sensor: JbdDialect(current_sign=sensor.current_sign),
    "daly": lambda sensor: DalyDialect(current_sign=sensor.current_sign, address=sensor.address),
    "jk": lambda sensor: JkDialect(current_sign=sensor.current_sign, address=sensor.address),
}
"""By the protocol's name in the settings and in the header of a capture."""


def make_dialect(sensor: SensorSettings) -> DeviceProtocol:
    """What ``[sensor]`` asks for; it turns the sign of the current."""
    return DIALECTS[sensor.protocol](sensor)
