"""Frames of a CAN bus with a pack's values: ``[source]`` with ``kind = "can"``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.polled_source import PolledSource, with_profile

MAX_ID, MAX_EXTENDED_ID = 0x7FF, 0x1FFF_FFFF
"""Largest identifiers of eleven and of 29 bits."""
FRAME_BITS = 512
"""Length of the longest CAN FD frame [bits]."""
PROFILES: dict[str, dict[str, object]] = {
    # Frame 0x356 of the battery-to-inverter protocol of Pylontech's low voltage packs, as BMS, inverters and diyBMS
    # (pylon_canbus.cpp) speak it: three int16, little endian, in 10 mV, 0.1 A and 0.1 degC; 500 kbit/s.
    "pylontech-can": {
        "bitrate": 500_000,
        "voltage": {"id": 0x356, "start_bit": 0, "bits": 16, "signed": True, "scale": 0.01},
        "current": {"id": 0x356, "start_bit": 16, "bits": 16, "signed": True, "scale": 0.1},
        "temperature": {"id": 0x356, "start_bit": 32, "bits": 16, "signed": True, "scale": 0.1},
    },
}
"""Defaults of ``[source]`` for buses with known signals, by name. All of them report charge as positive."""


class Signal(Strict):
    """Value on the bus, given by its name in the DBC file or by its position in a frame."""

    signal: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="name in the DBC file: Signal, or Message.Signal if several messages have it"
    )
    id: Annotated[int, Field(ge=0, le=MAX_EXTENDED_ID)] | None = Field(
        default=None, description="identifier of the frame, such as 0x356"
    )
    extended: bool = Field(default=False, description="the identifier has 29 bits")
    start_bit: Annotated[int, Field(ge=0, lt=FRAME_BITS)] = Field(
        default=0, description="first bit, counted as in a DBC file: the highest bit of a big endian value"
    )
    bits: Annotated[int, Field(ge=1, le=64)] = Field(default=16, description="length")
    byte_order: Literal["little", "big"] = "little"
    signed: bool = False
    scale: float = Field(
        default=1.0, description="factor from the raw value, or the value by the DBC file, to V, A or degC"
    )
    offset: float = Field(default=0.0, description="offset added after scale")
    absent: int | None = Field(default=None, description="raw value that means not measured, such as 0x7FFF")

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale: must not be 0")
        if (self.signal is None) == (self.id is None):
            raise ValueError("give signal, a name in the DBC file, or id, start_bit and bits, and not both")
        if self.id is not None and self.id > MAX_ID and not self.extended:
            raise ValueError("id: above 0x7FF it has 29 bits: extended = true")
        return self


class CellSignals(Signal):
    """Cell voltages: consecutive in a frame, or in numbered signals."""

    count: Annotated[int, Field(ge=1, le=96)] = Field(
        default=1, description="number of consecutive values of equal length, or of numbers from first for {} in signal"
    )
    first: Annotated[int, Field(ge=0)] = Field(default=1, description="number of the first cell in signal")

    @model_validator(mode="after")
    def _counted(self) -> Self:
        if self.signal is not None and self.count > 1 and "{}" not in self.signal:
            raise ValueError("signal: must contain {} for the number of the cell if count is above 1")
        whole_bytes = self.start_bit % 8 == 7 and self.bits % 8 == 0
        if self.signal is None and self.count > 1 and self.byte_order == "big" and not whole_bytes:
            raise ValueError("count: consecutive big endian values must be whole bytes; give each cell separately")
        return self

    def members(self) -> tuple[Signal, ...]:
        """Return one signal for each cell."""
        one = Signal(**self.model_dump(exclude={"count", "first"}))
        if self.signal is not None:
            names = [self.signal.replace("{}", str(self.first + number)) for number in range(self.count)]
            return tuple(one.model_copy(update={"signal": name}) for name in names)
        starts = [self.start_bit + number * self.bits for number in range(self.count)]
        return tuple(one.model_copy(update={"start_bit": start}) for start in starts)


class CanSource(PolledSource):
    """CAN bus, receive only."""

    kind: Literal["can"]
    profile: str | None = Field(default=None, description=f"bus with known signals: {', '.join(PROFILES)}")
    interface: Annotated[str, Field(min_length=1)] = Field(
        default="socketcan", description="interface of python-can: socketcan, slcan, pcan, gs_usb, ..."
    )
    channel: Annotated[str, Field(min_length=1)] = Field(
        default="can0", description="network interface, or path of the adapter's serial port"
    )
    bitrate: Annotated[int, Field(ge=10_000, le=8_000_000)] | None = Field(
        default=None, description="bit rate for adapters that need it; socketcan uses the system's"
    )
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict, description="further arguments of python-can's Bus"
    )
    dbc: Path | None = Field(default=None, description="DBC file (or KCD, ARXML, SYM) with the signals")
    interval_s: Annotated[float, Field(ge=0.001, le=600)] = Field(
        default=1.0, description="expected sample period on the bus"
    )
    voltage: Signal = Field(
        description='pack voltage: { signal = "PackVoltage" }, or { id = 0x356, start_bit = 0, bits = 16, scale = 0.01 }'
    )
    current: Signal = Field(description="as voltage; sensor.current_sign gives the sign")
    temperature: Signal | None = Field(default=None, description="as voltage")
    cells: tuple[CellSignals, ...] = Field(default=(), description="list of signals of cells, each with its count")

    @model_validator(mode="before")
    @classmethod
    def _profile(cls, table: object) -> object:
        return with_profile(table, PROFILES)

    @model_validator(mode="after")
    def _named_in_a_file(self) -> Self:
        signals = [self.voltage, self.current, *self.cells, *([self.temperature] if self.temperature else [])]
        if self.dbc is None and any(signal.signal is not None for signal in signals):
            raise ValueError("dbc: missing, but required for signals by name")
        if sum(cells.count for cells in self.cells) > 96:
            raise ValueError("cells: at most 96")
        return self

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]."""
        return self.interval_s

    @property
    def described(self) -> str:
        """Description in a few words."""
        return f"CAN {self.interface} {self.channel}"

    @property
    def sensor(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults: sign of a known bus, and resolution of signals without a DBC file."""
        sign = {"current_sign": "charge_positive"} if self.profile else {}
        volts = {} if self.voltage.signal else {"voltage_resolution_v": abs(self.voltage.scale)}
        amperes = {} if self.current.signal else {"current_resolution_a": abs(self.current.scale)}
        return {**sign, **volts, **amperes}
