"""Description of a pack by its devices and cells, by which a new pack is distinguished from a renamed one."""

from typing import NamedTuple, Self

from bms_estimator.settings.pack import BmsSettings, Settings
from bms_estimator.settings.sources.ble import BleSource
from bms_estimator.settings.sources.modbus import ModbusSource
from bms_estimator.settings.sources.mqtt import MqttSource, ValueLocation

SERIAL_IDS = "/dev/serial/by-id/"
"""Folder of the names of serial ports that contain the serial number of the device."""


class PackDescription(NamedTuple):
    """Devices and cells of a pack."""

    devices: tuple[tuple[str, str], ...] = ()
    """Kind and address of each device. The kind is empty if the system may give the address to another device."""
    cells: str = ""
    """Cell and number of cells in series."""

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return the description of a pack."""
        devices = tuple(_device(each) for each in (settings, settings.bms) if each)
        return cls(devices, f"{settings.pack.series} {settings.pack.cell}")

    def differs(self, devices: object, cells: object) -> bool:
        """Return True only if a saved description is surely that of another pack.

        No device may be the same. Besides, either the cells must differ, or the devices must have addresses of one
        kind that are their own: topic, Bluetooth address, host, or serial number of a USB adapter. A device that is
        reached in another way may be the same one, and ports such as /dev/ttyUSB0 are renumbered. A topic or host that
        was renamed together with the pack counts as another device.

        Args:
            devices: Saved devices, as JSON; None: unknown.
            cells: Saved cells.
        """
        saved = [tuple(each) for each in devices] if isinstance(devices, list) else []
        if not saved or not self.devices or set(saved) & set(self.devices):
            return False
        return cells != self.cells or saved[0][0] == self.devices[0][0] != ""


def _device(settings: Settings | BmsSettings) -> tuple[str, str]:
    """Return kind and address of a device."""
    match settings.source:
        case MqttSource(voltage=ValueLocation() as voltage) as source:
            return "mqtt", " ".join(source.topics(voltage))
        case BleSource(address=address, name=name):
            return ("bluetooth address", address.upper()) if address else ("bluetooth name", name or "")
        case ModbusSource(host=str(host), tcp_port=port, unit=unit):
            return "modbus", f"{host}:{port} {unit}"
        case ModbusSource(port=port):
            address = port or ""
        case None:
            address = settings.sensor.port
        case source:
            address = source.short_description
    return ("serial" if address.startswith(SERIAL_IDS) else ""), address
