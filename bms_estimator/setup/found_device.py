"""Device that the search found, and its settings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bms_estimator.settings.pack import Settings
from bms_estimator.settings.settings_template import GivenSettings
from bms_estimator.setup.broker_login import BrokerLogin

NAME_SEPARATOR = ":"
"""Separator between profile and address in ``FoundDevice.name``."""
SAME_PACK_TOLERANCE = 0.02
"""Maximum relative difference between the voltages of two devices of one pack."""


@dataclass(frozen=True)
class FoundDevice:
    """Device that measures a pack."""

    name: str
    """Value of the option ``--device``: path of the serial port, or profile and address of the device."""
    description: str
    tables: GivenSettings
    """Settings of the device: ``[sensor]`` or ``[source]``."""
    cells: int | None = None
    """Number of cells in series, if the device reports it."""
    voltage_v: float | None = None
    """Voltage that was received during the search [V]; None: not received."""
    soc: float | None = None
    """SOC that the device reported during the search, 0..1; None: not reported."""
    capacity_ah: float | None = None
    """Capacity from which the device computes its SOC [Ah]; None: not reported."""
    values: str = ""
    """Values that were received during the search, as text; empty if the search received none."""
    broker: BrokerLogin | None = None
    """Broker to which an MQTT device publishes; None: another kind of device."""

    @property
    def settings(self) -> Settings:
        """Settings of a pack with this device. All other settings have their defaults, so that nothing is published."""
        return Settings.model_validate(self.tables_with(self.broker.temporary_settings if self.broker else {}))

    def tables_with(self, broker: Mapping[str, object]) -> dict[str, dict[str, Any]]:
        """Return the settings of the device, in which each MQTT source has these settings of its broker."""
        return {name: _with_broker(table, broker) for name, table in self.tables.items()}

    @property
    def has_cells(self) -> bool:
        """True if the device is a BMS, which measures its cells."""
        return self.cells is not None or self.tables.get("source", {}).get("kind") == "ble"

    def __str__(self) -> str:
        """Describe the device with the received values."""
        return f"{self.description}; {self.values}" if self.values else self.description


def with_pairs(devices: Sequence[FoundDevice]) -> list[FoundDevice]:
    """Return the devices, and each pair of a battery monitor, such as a shunt, and a BMS that may belong to one pack."""
    pairs = [
        _pair(a, b) for a in devices for b in devices if b.has_cells and not a.has_cells and _may_be_of_one_pack(a, b)
    ]
    return [*devices, *pairs]


def _may_be_of_one_pack(monitor: FoundDevice, bms: FoundDevice) -> bool:
    """Return True unless the voltages differ, or the devices publish to two brokers."""
    is_one_broker = not (monitor.broker and bms.broker) or monitor.broker == bms.broker
    voltage_v = monitor.voltage_v or bms.voltage_v or 0.0  # an unknown voltage may be that of the other device
    return is_one_broker and math.isclose(voltage_v, bms.voltage_v or voltage_v, rel_tol=SAME_PACK_TOLERANCE)


def _pair(monitor: FoundDevice, bms: FoundDevice) -> FoundDevice:
    """Return a device with current and voltage of a battery monitor, and cells and temperatures of a BMS."""
    return FoundDevice(
        name=f"{monitor.name}+{bms.name}",
        description=f"{monitor.description}, with cells and temperatures of {bms.name}",
        tables={**monitor.tables, "bms": bms.tables},
        cells=bms.cells,
        soc=bms.soc if monitor.soc is None else monitor.soc,
        capacity_ah=bms.capacity_ah if monitor.capacity_ah is None else monitor.capacity_ah,
        values=monitor.values,
        broker=monitor.broker or bms.broker,
    )


def _with_broker(table: Mapping[str, Any], broker: Mapping[str, object]) -> dict[str, Any]:
    """Return a table of settings; each MQTT source in it gets the settings of the broker."""
    inner = {key: _with_broker(each, broker) if isinstance(each, Mapping) else each for key, each in table.items()}
    return {**inner, **broker} if table.get("kind") == "mqtt" else inner


def values_text(voltage_v: float, current_a: float) -> str:
    """Return voltage and current as text; the current is positive on discharge."""
    if not round(current_a, 2):
        return f"{voltage_v:.2f} V, no current"
    return f"{voltage_v:.2f} V, {abs(current_a):.2f} A, {'discharging' if current_a > 0.0 else 'charging'}"
