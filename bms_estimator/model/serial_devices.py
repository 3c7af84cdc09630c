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

    def fill(self, sensor: Mapping[str, Any]) -> dict[str, Any]:
        """The table ``[sensor]`` with what it leaves out."""
        return {
            "baud": self.baud,
            "current_sign": self.current_sign,
            "voltage_resolution_v": self.voltage_resolution_v,
            **sensor,
        }


SERIAL_DEVICES: Mapping[str, SerialDevice] = {
    "binary": SerialDevice(),
    "text": SerialDevice(pace_s=1.0),
    "jbd": SerialDevice(9600, "charge_positive", 0.01, 1.0),
    "daly": SerialDevice(9600, "discharge_positive", 0.1, 1.0),
    "jk": SerialDevice(115_200, "charge_positive", 0.01, 1.0),
}
"""By the protocol's name; where each comes from stands with its dialect and in docs/sources-serial-bms.md."""
