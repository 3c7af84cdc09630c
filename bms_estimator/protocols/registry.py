"""All device protocols by their names.

All modules of ``protocols.devices`` are registered automatically, so that a new device needs only one new file.
"""

import importlib
import pkgutil
from collections.abc import Mapping

from bms_estimator.protocols import devices
from bms_estimator.protocols.base.polled_protocol import Device, Sensor
from bms_estimator.protocols.base.reading_protocol import DeviceProtocol

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


def max_batteries(protocol: str) -> int:
    """Return the maximum number of batteries in parallel whose values a protocol sums; 1: it has one battery."""
    return DEVICES[protocol].max_batteries if protocol in DEVICES else 1


def make_protocol(sensor: Sensor) -> DeviceProtocol:
    """Make the protocol of a device; its samples are corrected, and have the sign of current that the estimator expects."""
    protocol = _make_uncorrected(sensor)
    protocol.correction = sensor.correction
    return protocol


def _make_uncorrected(sensor: Sensor) -> DeviceProtocol:
    if sensor.protocol == BOARD:
        from bms_estimator.protocols.firmware.protocol import BoardProtocol  # noqa: PLC0415 - it loads numba

        return BoardProtocol(current_sign=sensor.current_sign, rate_hz=sensor.sample_rate_hz)
    return DEVICES[sensor.protocol].make(sensor)
