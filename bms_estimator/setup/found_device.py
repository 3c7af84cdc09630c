"""Device that the search found, and its settings."""

from dataclasses import dataclass

from bms_estimator.settings.pack import Settings
from bms_estimator.settings.settings_template import GivenSettings
from bms_estimator.setup.broker_login import BrokerLogin

NAME_SEPARATOR = ":"
"""Separator between profile and address in ``FoundDevice.name``."""


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
    values: str = ""
    """Values that were received during the search, as text; empty if the search received none."""
    broker: BrokerLogin | None = None
    """Broker to which an MQTT device publishes; None: another kind of device."""

    @property
    def settings(self) -> Settings:
        """Settings of a pack with this device. All other settings have their defaults, with which nothing is published."""
        source = dict(self.tables.get("source", {}))
        if self.broker is not None:
            source |= self.broker.temporary_settings
        return Settings.model_validate({**self.tables, **({"source": source} if source else {})})

    def __str__(self) -> str:
        """Describe the device with the received values."""
        return f"{self.description}; {self.values}" if self.values else self.description


def values_text(voltage_v: float, current_a: float) -> str:
    """Return voltage and current as text; the current is positive on discharge."""
    if not round(current_a, 2):
        return f"{voltage_v:.2f} V, no current"
    return f"{voltage_v:.2f} V, {abs(current_a):.2f} A, {'discharging' if current_a > 0.0 else 'charging'}"
