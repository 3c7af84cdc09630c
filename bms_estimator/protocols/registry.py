"""All device protocols by their names.

All modules of ``protocols.devices`` are registered automatically, so that a new device needs only one new file.
"""

import importlib
import pkgutil
from collections.abc import Mapping
from typing import Protocol

from bms_estimator.model.sample import CurrentSign
from bms_estimator.protocols import devices
from bms_estimator.protocols.base.device import Device
from bms_estimator.protocols.base.device_protocol import DeviceProtocol
from bms_estimator.protocols.base.sensor_correction import SensorCorrection

BOARD = "binary"
"""Name of the firmware's protocol. It is not a ``Device``, because its decoder imports numba, which other devices do not need."""


def _find_devices() -> dict[str, Device]:
    """Import every module of ``protocols.devices``; return its ``DEVICE`` by name, devices that send text first."""
    modules = (
        importlib.import_module(f"{devices.__name__}.{each.name}") for each in pkgutil.iter_modules(devices.__path__)
    )
    found_devices: list[Device] = [module.DEVICE for module in modules]
    return {
        device.name: device
        for device in sorted(found_devices, key=lambda device: (device.has_binary_frames, device.name))
    }


DEVICES: Mapping[str, Device] = _find_devices()
"""Devices by their names in ``sensor.protocol``."""
PROTOCOLS = (BOARD, *DEVICES)
"""Values of ``sensor.protocol``."""


def valid_addresses(protocol: str) -> range:
    """Return the valid values of ``sensor.address``; empty for a protocol without addresses."""
    return DEVICES[protocol].addresses if protocol in DEVICES else range(0)


class Sensor(Protocol):
    """Part of ``[sensor]`` that a protocol depends on."""

    @property
    def protocol(self) -> str:
        """Name of the protocol, one of ``PROTOCOLS``."""

    @property
    def current_sign(self) -> CurrentSign:
        """Direction of the current that the device reports as positive."""

    @property
    def address(self) -> int | None:
        """Address of the device on its bus; None: the first that responds."""

    @property
    def sample_rate_hz(self) -> int:
        """Sample rate that a board of the firmware is set to [Hz]."""

    @property
    def correction(self) -> SensorCorrection:
        """Correction of the measured values."""


def make_protocol(sensor: Sensor) -> DeviceProtocol:
    """Make the protocol of a device; its samples are corrected, and have the sign of current that the estimator expects."""
    protocol = _make_uncorrected(sensor)
    protocol.correction = sensor.correction
    return protocol


def _make_uncorrected(sensor: Sensor) -> DeviceProtocol:
    if sensor.protocol == BOARD:
        from bms_estimator.protocols.firmware.protocol import BoardProtocol  # noqa: PLC0415 - it loads numba

        return BoardProtocol(current_sign=sensor.current_sign, rate_hz=sensor.sample_rate_hz)
    return DEVICES[sensor.protocol].make(sensor.current_sign, sensor.address)
