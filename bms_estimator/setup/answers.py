"""Answers about a new pack, and the settings that follow from them."""

from dataclasses import dataclass

from bms_estimator.model.decimal_text import number
from bms_estimator.settings.settings_template import GivenSettings
from bms_estimator.setup.found_device import FoundDevice


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
    voltage_v: float | None = None
    """Measured voltage of the pack [V]; None: not measured."""
    name: str | None = None
    cell: str | None = None
    capacity_ah: float | None = None
    """Capacity of one cell [Ah]."""
    series: int | None = None
    parallel: int | None = None
    max_discharge_a: float | None = None
    """Largest discharge current of the pack [A]; None: no limit is configured."""
    max_charge_a: float | None = None
    """Largest charge current of the pack [A]; None: no limit is configured."""
    broker: str | None = None
    """URL of the broker to which the service publishes; empty: no broker."""
    found_broker: str | None = None
    """URL of a broker that answered during the search; None: no broker answered."""
    sensor: tuple[tuple[str, object], ...] = ()
    """Settings of ``[sensor]`` from the comparison with a multimeter: key and value of each."""

    @property
    def tables(self) -> GivenSettings:
        """Settings of the pack by section and key."""
        pack = {key: getattr(self, key) for key in ("name", "cell", "capacity_ah", "series", "parallel")}
        limits = {"max_discharge_a": self.max_discharge_a, "max_charge_a": self.max_charge_a}
        pack |= {key: limit_a for key, limit_a in limits.items() if limit_a is not None}
        tables: dict[str, dict[str, object]] = {"pack": pack}
        for section, values in self.device.tables.items():
            tables[section] = dict(values)
        if self.sensor:
            tables["sensor"] = {**tables.get("sensor", {}), **dict(self.sensor)}
        if self.broker:
            tables["mqtt"] = {"url": self.broker}
        if self.device.broker and self.device.broker != self.broker:
            tables["source"]["url"] = self.device.broker
        return tables
