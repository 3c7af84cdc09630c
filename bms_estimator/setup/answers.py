"""Answers about a new pack, and the settings that follow from them."""

from collections.abc import Mapping
from dataclasses import dataclass

from bms_estimator.model.decimal_text import number
from bms_estimator.settings.connections import DEFAULT_LISTEN
from bms_estimator.settings.settings_template import GivenSettings
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.found_device import FoundDevice
from bms_estimator.setup.measurement import Measurement


class InvalidAnswerError(Exception):
    """An answer is malformed or implausible. The message contains the answer and the reason."""


def parse_number(text: str, unit: str = "") -> float:
    """Return the number in an answer, with a decimal point or comma, and with or without its unit.

    Raises:
        InvalidAnswerError: The text is not a number.
    """
    digits = text[: -len(unit)] if unit and text.lower().endswith(unit.lower()) else text
    try:
        return number(digits.replace(",", "."))
    except ValueError:
        raise InvalidAnswerError(f"{text}: must be a number, such as {f'12 {unit}'.strip()}") from None


@dataclass(frozen=True)
class Answers:
    """Answers so far; None: not answered yet."""

    device: FoundDevice
    measured: Measurement | None = None
    """Values of the device; None: no sample arrived."""
    name: str | None = None
    cell: str | None = None
    capacity_ah: float | None = None
    """Capacity of one cell [Ah]."""
    series: int | None = None
    parallel: int | None = None
    full_voltage_v: float | None = None
    """Voltage of the pack at which its charger stops [V]; None: that of the cell file applies."""
    cutoff_voltage_v: float | None = None
    """Voltage of the pack at which its BMS ends a discharge [V]; None: that of the cell file applies."""
    max_discharge_a: float | None = None
    """Largest discharge current of the pack [A]; None: no limit is configured."""
    max_charge_a: float | None = None
    """Largest charge current of the pack [A]; None: no limit is configured."""
    device_soc_std: float | None = None
    """Std of the device's SOC as initial SOC of the pack; None: this SOC is not used."""
    broker: BrokerLogin | None = None
    """Broker to which the service publishes; None: no broker."""
    found_broker: BrokerLogin | None = None
    """Broker that answered during the search; None: no broker answered."""
    sensor: tuple[tuple[str, object], ...] = ()
    """Settings of ``[sensor]`` from the comparison with a multimeter: key and value of each."""
    page_listen: str = DEFAULT_LISTEN
    """Address of the page."""

    @property
    def voltage_v(self) -> float | None:
        """Measured voltage of the pack [V]; None: not measured."""
        return self.measured.voltage_v if self.measured else None

    @property
    def device_capacity_ah(self) -> float | None:
        """Capacity of the pack that its device reports [Ah]; None: not reported."""
        measured_ah = self.measured.capacity_ah if self.measured else None
        return self.device.capacity_ah if measured_ah is None else measured_ah

    @property
    def logins(self) -> Mapping[str, BrokerLogin]:
        """Brokers of the pack by section. The source uses the broker of ``[mqtt]`` unless it has its own."""
        source = None if self.device.broker == self.broker else self.device.broker
        return {section: login for section, login in (("mqtt", self.broker), ("source", source)) if login}

    def password_file(self, section: str) -> str:
        """Return the name of the file with the password for the broker of a section. It is in the folder of the settings file."""
        return f"{self.name}-{section}.password"

    @property
    def tables(self) -> GivenSettings:
        """Settings of the pack by section and key. The password files are in the folder of the settings file."""
        return self._tables({key: login.settings(self.password_file(key)) for key, login in self.logins.items()})

    @property
    def temporary_tables(self) -> GivenSettings:
        """Settings of the pack with temporary password files."""
        return self._tables({section: login.temporary_settings for section, login in self.logins.items()})

    def _tables(self, brokers: GivenSettings) -> GivenSettings:
        pack = {key: getattr(self, key) for key in ("name", "cell", "capacity_ah", "series", "parallel")}
        optional = ("full_voltage_v", "cutoff_voltage_v", "max_discharge_a", "max_charge_a", "device_soc_std")
        pack |= {key: value for key in optional if (value := getattr(self, key)) is not None}
        tables = {"pack": pack, **self.device.tables_with(brokers.get("source", {}))}
        if self.sensor:
            tables["sensor"] = {**tables.get("sensor", {}), **dict(self.sensor)}
        tables["page"] = {"listen": self.page_listen}
        # without a login, every client of the broker could acknowledge a critical alarm, after which a relay closes
        commands = {"commands": ["acknowledge_alarm"]} if self.broker and self.broker.username else {}
        return tables | ({"mqtt": {**brokers["mqtt"], **commands}} if "mqtt" in brokers else {})
