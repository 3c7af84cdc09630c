"""What devices resolve of a pack: defaults of ``[sensor]`` by its ``protocol``, each with where it comes from.

The table says what stands in a device's messages, and what its makers and users say of small currents. A setting in the
file takes the place of the device's.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Resolution:
    """Of one kind of device. None: as a board of the firmware has it."""

    baud: int | None = None
    """Of its serial port."""
    current_sign: str | None = None
    """What it calls positive."""
    period_s: float | None = None
    """Between two samples [s]."""
    voltage_resolution_v: float | None = None
    """One step of the pack's voltage [V]."""
    current_resolution_a: float | None = None
    """One step of the current [A]."""
    current_dead_band_a: float | None = None
    """Smaller currents are shown as 0 [A]."""


CHARGE = "charge_positive"
RESOLUTIONS: Mapping[str, Resolution] = {
    # Boards that print at their own pace are taken to do so each second.
    "text": Resolution(period_s=1.0),
    # Steps of 10 mV and 10 mA in one frame with both. Users saw nothing below 0.2 A, and 0.5 A on one of 120 A
    # (github.com/smagicld/xiaoxiangBMS, issues 115 and 39).
    "jbd": Resolution(9600, CHARGE, 1.0, 0.01, 0.01, 0.5),
    # Steps of 0.1 V and 0.1 A in one frame with both. Its DfilterCur was found at 2 A, and 2.5 A
    # (github.com/softwarecrash/Daly2MQTT, issue 171; github.com/fl4p/batmon-ha, issue 144).
    "daly": Resolution(9600, None, 1.0, 0.1, 0.1, 2.5),
    # Steps of 10 mV and 10 mA in one frame with both. One showed nothing below 0.7 A (github.com/syssi/esphome-jk-bms, issue 243).
    "jk": Resolution(115_200, CHARGE, 1.0, 0.01, 0.01, 0.7),
    # The text has steps of 1 mV and 1 mA; the data sheets of BMV and SmartShunt promise 10 mV and 10 mA.
    "vedirect": Resolution(19_200, CHARGE, 1.0, 0.01, 0.01),
    # Steps of 10 mV and 10 mA in the protocol; of the current the makers promise 0.1 A.
    "junctek": Resolution(115_200, CHARGE, 1.0, 0.01, 0.1),
    # Steps of 1 mV and 1 mA in the table. Of public captures the smallest current that is not 0 is 149 mA, beside many of 0.
    "pylontech": Resolution(115_200, CHARGE, 2.0, 0.001, 0.01, 0.1),
}
"""By ``sensor.protocol``."""


@dataclass(frozen=True)
class Sampling:
    """What the estimator is told of a source's current and time; the defaults are those of a board of the firmware."""

    period_s: float = 0.01
    """Between two samples [s]."""
    current_resolution_a: float = 0.0
    """One step of the current [A]; 0: as good as none."""
    current_dead_band_a: float = 0.0
    """Smaller currents are shown as 0 [A]."""


BOARD = Sampling()
"""A board of the firmware."""
