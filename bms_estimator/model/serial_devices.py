"""What a serial device is by its protocol: what the settings say of it where the user does not."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class SerialDevice:
    """Defaults of ``[sensor]`` for one protocol."""

    baud: int = 500_000
    current_sign: Literal["discharge_positive", "charge_positive"] = "discharge_positive"
    """What it calls positive by its documentation."""
    voltage_resolution_v: float = 25.0 / 1024
    """One step of the voltage it tells [V]."""
    pace_s: float | None = None
    """Between two samples [s]; None: as ``sample_rate_hz`` asks for."""


SERIAL_DEVICES: Mapping[str, SerialDevice] = {
    "binary": SerialDevice(),
    "text": SerialDevice(pace_s=1.0),
    "jbd": SerialDevice(9600, "charge_positive", 0.01, 1.0),
    "daly": SerialDevice(9600, "discharge_positive", 0.1, 1.0),
    "jk": SerialDevice(115_200, "charge_positive", 0.01, 1.0),
}
"""By the protocol's name; where each comes from stands with its dialect and in docs/sources-serial-bms.md."""


def filled(sensor: Mapping[str, Any]) -> Mapping[str, Any]:
    """The table ``[sensor]`` with what it leaves out, as its protocol has it."""
    protocol = sensor.get("protocol", "binary")
    device = SERIAL_DEVICES.get(protocol) if isinstance(protocol, str) else None
    if device is None:
        return sensor
    return {
        "baud": device.baud,
        "current_sign": device.current_sign,
        "voltage_resolution_v": device.voltage_resolution_v,
        **sensor,
    }
