"""Description of a BMS or meter: its name in the settings, its default settings and its protocol."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from bms_estimator.model.sample import CurrentSign
from bms_estimator.protocols.base.reading_protocol import DeviceProtocol
from bms_estimator.protocols.base.sensor_correction import SensorCorrection

BMS_GAIN_STD = 0.005
"""Relative std of the gains of a BMS. Vendors state 0.5 % for the pack voltage, and seldom a smaller error."""


@dataclass(frozen=True)
class SensorDefaults:
    """Defaults of ``[sensor]`` for one kind of device. None: the default of the firmware's board."""

    baud: int | None = None
    """Baud rate of the serial port [1/s]."""
    current_sign: CurrentSign | None = None
    """Direction of the current that the device reports as positive."""
    period_s: float | None = None
    """Time between two samples [s]."""
    voltage_resolution_v: float | None = None
    """Smallest step of the pack's voltage [V]."""
    current_resolution_a: float | None = None
    """Smallest step of the current [A]."""
    current_dead_band_a: float | None = None
    """Current below which the device reports 0 [A]."""
    voltage_gain_std: float = BMS_GAIN_STD
    """Relative std of the voltage sensor's gain."""
    current_gain_std: float = BMS_GAIN_STD
    """Relative std of the current sensor's gain."""


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
    def batteries(self) -> int | None:
        """Number of batteries whose values are summed; None: as many as the first reading has."""

    @property
    def sample_rate_hz(self) -> int:
        """Sample rate that a board of the firmware is set to [Hz]."""

    @property
    def correction(self) -> SensorCorrection:
        """Correction of the measured values."""


@dataclass(frozen=True)
class Device:
    """Kind of device.

    Each module of ``protocols.devices`` declares its device as the constant ``DEVICE``, and nowhere else.

    Attributes:
        name: Value of ``sensor.protocol``.
        make: Creates the protocol.
        sensor_defaults: Defaults of ``[sensor]``.
        has_binary_frames: True if the frames are not lines of text. A device search sends binary queries last, because a device that
            reads lines would interpret them as the beginning of a line.
        addresses: Valid values of ``sensor.address``; empty: the protocol has no addresses.
        max_batteries: Maximum number of batteries in parallel whose values are summed; 1: the protocol has one battery.
    """

    name: str
    make: Callable[[Sensor], DeviceProtocol]
    sensor_defaults: SensorDefaults
    has_binary_frames: bool = False
    addresses: range = range(0)
    max_batteries: int = 1
