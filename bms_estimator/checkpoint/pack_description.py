"""Description of a pack by its devices and cells, by which a new pack is distinguished from a renamed one."""

from typing import NamedTuple, Self

from bms_estimator.settings.pack import BmsSettings, Settings
from bms_estimator.settings.sources.ble import BleSource

SERIAL_IDS = "/dev/serial/by-id/"
"""Folder of the names of serial ports that contain the serial number of the device."""


class PackDescription(NamedTuple):
    """Devices and cells of a pack."""

    devices: tuple[tuple[str, str], ...] = ()
    """Kind and address of each device. The kind is empty if the hardware does not give the address."""
    cells: str = ""
    """Cell and number of cells in series."""

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return the description of a pack."""
        devices = tuple(_device(each) for each in (settings, settings.bms) if each)
        return cls(devices, f"{settings.pack.series} {settings.pack.cell}")

    def differs(self, devices: object, cells: object) -> bool:
        """Return True only if a saved description is surely that of another pack.

        No device may be the same. Besides, either the cells must differ, or both devices must have an address of one
        kind that the hardware gives: Bluetooth address, or serial number of a USB adapter. A topic or host may have been
        renamed together with the pack, and a latched alarm must survive this.

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
    source = settings.source
    if isinstance(source, BleSource) and source.address:
        return "bluetooth", source.address.upper()
    address = settings.sensor.port if source is None else source.short_description
    return ("serial" if address.startswith(SERIAL_IDS) else ""), address
