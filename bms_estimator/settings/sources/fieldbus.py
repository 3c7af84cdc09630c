"""Settings of field buses as sources of samples: CAN and Modbus."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.sources.source import BaseSource, as_tuple, merge_profile

CAN_PROFILES: dict[str, dict[str, object]] = {
    "pylontech-can": {
        "bitrate": 500_000,
        "voltage": {"signal": "PackVoltage"},
        "current": {"signal": "PackCurrent"},
        "temperature": {"signal": "PackTemperature"},
        "soc": {"signal": "PackSoc"},
    },
}
"""Defaults of ``[source]`` by profile. The package contains a DBC file for each profile. All of them report charge as
positive."""
RESOLUTIONS: dict[str, dict[str, object]] = {
    "pylontech-can": {"voltage_resolution_v": 0.01, "current_resolution_a": 0.1},
}
"""Defaults of ``[sensor]`` by profile: the scale factors of the profile's DBC file."""
LAYOUT_KEYS = ("id", "extended", "start_bit", "bits", "byte_order", "signed")
"""Settings of former versions, which described the place of a signal in a frame."""
MAX_CELLS = 96
"""Maximum number of cells of a pack."""


class Signal(Strict):
    """Signal of the DBC file."""

    signal: Annotated[str, Field(min_length=1)] = Field(
        description="name of the signal in the DBC file; Message.Signal if several messages have a signal of this name"
    )
    scale: float = Field(default=1.0, description="factor from the DBC file's unit to V, A or degC")
    offset: float = Field(default=0.0, description="offset that is added after scale")
    absent: float | None = Field(
        default=None, description="value that marks a missing measurement, in the DBC file's unit, such as 3276.7"
    )

    @model_validator(mode="before")
    @classmethod
    def _reject_layout(cls, table: object) -> object:
        layout = [key for key in LAYOUT_KEYS if key in table] if isinstance(table, dict) else []
        if layout:
            raise ValueError(
                f"{', '.join(layout)}: not supported; describe the signal in a DBC file, set source.dbc to its path, "
                'and name the signal here: { signal = "PackVoltage" } (example in docs/pack/fieldbus.md)'
            )
        return table

    @model_validator(mode="after")
    def _check_scale(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale: must not be 0")
        return self


class CellSignals(Signal):
    """Cell voltages in numbered signals."""

    count: Annotated[int, Field(ge=1, le=MAX_CELLS)] = Field(
        default=1, description="number of cells; {} in signal stands for the cell number"
    )
    first: Annotated[int, Field(ge=0)] = Field(
        default=1, description="number that replaces {} in signal for the first cell"
    )

    @model_validator(mode="after")
    def _check_cell_placeholder(self) -> Self:
        if self.count > 1 and "{}" not in self.signal:
            raise ValueError("signal: must contain {}, which stands for the cell number, because count is above 1")
        return self

    def cell_signals(self) -> tuple[Signal, ...]:
        """Return one signal for each cell."""
        template = Signal(**self.model_dump(exclude={"count", "first"}))
        names = [self.signal.replace("{}", str(self.first + number)) for number in range(self.count)]
        return tuple(template.model_copy(update={"signal": name}) for name in names)


class CanSource(BaseSource):
    """CAN bus, on which the service sends nothing."""

    kind: Literal["can"] = Field(description="kind of this source")
    profile: str | None = Field(
        default=None, description=f"CAN protocol whose signals are known: {', '.join(CAN_PROFILES)}"
    )
    interface: Annotated[str, Field(min_length=1)] = Field(
        default="socketcan", description="interface of python-can: socketcan, slcan, pcan, gs_usb, ..."
    )
    channel: Annotated[str, Field(min_length=1)] = Field(
        default="can0", description="network interface, or path of the adapter's serial port"
    )
    bitrate: Annotated[int, Field(ge=10_000, le=8_000_000)] | None = Field(
        default=None,
        description="bit rate, for adapters that require it; socketcan uses the bit rate that the system has set",
    )
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict, description="further arguments of the class Bus of python-can"
    )
    dbc: Path | None = Field(
        default=None,
        description="DBC, KCD, ARXML or SYM file that describes the signals; default: DBC file of the profile",
    )
    interval_s: Annotated[float, Field(ge=0.001, le=600)] = Field(
        default=1.0, description="expected sample period of the values on the bus"
    )
    voltage: Signal = Field(description='signal of the pack voltage, such as { signal = "PackVoltage" }')
    current: Signal = Field(
        description="signal of the current, written like voltage; sensor.current_sign is the direction of positive current"
    )
    temperature: Annotated[tuple[Signal, ...], BeforeValidator(as_tuple)] = Field(
        default=(), description="signal of the temperature, written like voltage; a list for several probes"
    )
    soc: Signal | None = Field(
        default=None,
        description="signal of the SOC that the BMS reports [%], written like voltage; it is shown beside the estimate",
    )
    cells: tuple[CellSignals, ...] = Field(
        default=(),
        description='signals of the cell voltages, such as [{ signal = "Cell{}_mV", count = 16, scale = 0.001 }]',
    )

    @model_validator(mode="before")
    @classmethod
    def _merge_profile(cls, table: object) -> object:
        if isinstance(table, dict) and "dbc" in table:  # a configured DBC file need not have the profile's SOC signal
            return merge_profile(table, {name: {**each, "soc": None} for name, each in CAN_PROFILES.items()})
        return merge_profile(table, CAN_PROFILES)

    @model_validator(mode="after")
    def _check_dbc_and_cells(self) -> Self:
        if self.dbc is None and self.profile is None:
            raise ValueError("dbc: missing; give a DBC file that describes the signals")
        if sum(cells.count for cells in self.cells) > MAX_CELLS:
            raise ValueError(f"cells: must be at most {MAX_CELLS} cells")
        return self

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]."""
        return self.interval_s

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        return f"CAN {self.interface} {self.channel}"

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults of a profile: its current sign, and its resolutions unless ``dbc`` replaces its DBC file."""
        if self.profile is None:
            return {}
        resolutions = RESOLUTIONS[self.profile] if self.dbc is None else {}
        return {"current_sign": "charge_positive", **resolutions}


MAX_WORDS = 125
"""Maximum number of registers, which are 16-bit words, in a request (Modbus application protocol V1.1b3, section 6.3)."""
ADDRESS_END = 0x10000
"""First address beyond the last register, 65535."""
WORDS = {"int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "float32": 2}
"""Number of registers of a value, by its type."""
MODBUS_PROFILES: dict[str, dict[str, object]] = {
    # Victron's register list (attributes.csv of dbus_modbustcp), service com.victronenergy.battery; functions 3 and 4
    # read equal values. The unit is shown under Settings, Services, Modbus TCP, Available services; 225 is that of a BMV.
    # Unmeasured values read 0 (Mappings::getValue of dbus_modbustcp), also the temperature of a BMV without a sensor.
    "victron-gx": {
        "unit": 225,
        "voltage": {"address": 259, "type": "uint16", "scale": 0.01, "absent": 0},
        "current": {"address": 261, "type": "int16", "scale": 0.1},
        "temperature": {"address": 262, "type": "int16", "scale": 0.1, "absent": 0},
        "soc": {"address": 266, "type": "uint16", "scale": 0.1, "absent": 0},
    },
    # "SEPLOS-3.0 RS485 BMS Modbus RTU Protocol" V0.1 of 2023-02-09: blocks PIA and PIB, function 4, temperatures in 0.1 K.
    "seplos-v3": {
        "baud": 19200,
        "unit": 0,
        "voltage": {"address": 0x1000, "table": "input", "type": "uint16", "scale": 0.01},
        "current": {"address": 0x1001, "table": "input", "type": "int16", "scale": 0.01},
        "temperature": [  # mean, highest and lowest of the cells' probes
            {"address": address, "table": "input", "type": "uint16", "scale": 0.1, "offset": -273.15, "absent": 0}
            for address in (0x1009, 0x100C, 0x100D)
        ],
        "soc": {"address": 0x1005, "table": "input", "type": "uint16", "scale": 0.1},
        "capacity": {"address": 0x1003, "table": "input", "type": "uint16", "scale": 0.01},
        "cells": {"address": 0x1100, "table": "input", "type": "uint16", "scale": 0.001, "count": 16},
    },
}
"""Defaults of ``[source]`` for devices with known registers, by name. All of them report charge as positive."""


class Register(Strict):
    """Value of the device: content of its registers times ``scale``, plus ``offset``."""

    address: Annotated[int, Field(ge=0, le=0xFFFF)] = Field(
        description="register address in the request, counted from 0; 40001 in a manual is holding register 0"
    )
    table: Literal["holding", "input"] = Field(default="holding", description="holding: function 3; input: function 4")
    type: Literal["int16", "uint16", "int32", "uint32", "float32"] = "uint16"
    low_word_first: bool = Field(
        default=False, description="true: the first of two registers is the low word of the value"
    )
    scale: float = Field(default=1.0, description="factor from the register value to V, A or degC")
    offset: float = Field(default=0.0, description="offset that is added after scale, such as -273.15")
    absent: int | None = Field(
        default=None, description="register value that marks a missing measurement, such as 32767"
    )

    @model_validator(mode="after")
    def _check_scale_and_address(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale: must not be 0")
        if self.address + self.words > ADDRESS_END:
            raise ValueError("address: the value ends beyond the last register, 65535")
        return self

    @property
    def words(self) -> int:
        """Number of registers of the value."""
        return WORDS[self.type]


class CellRegisters(Register):
    """Registers of cell voltages at equal distances."""

    count: Annotated[int, Field(ge=1, le=96)] = Field(description="number of cells")
    step: Annotated[int, Field(ge=1, le=MAX_WORDS)] | None = Field(
        default=None, description="number of registers from one cell to the next; default: consecutive registers"
    )

    def cell(self, number: int) -> Register:
        """Return the register of a cell; numbers start from 0."""
        first_cell = Register(**self.model_dump(exclude={"count", "step"}))
        return first_cell.model_copy(update={"address": self.address + number * (self.step or self.words)})

    @model_validator(mode="after")
    def _check_last_address(self) -> Self:
        if self.cell(self.count - 1).address + self.words > ADDRESS_END:
            raise ValueError("count: the last cell lies beyond the last register, 65535")
        return self


class ModbusSource(BaseSource):
    """Modbus device on the network or on a serial line."""

    kind: Literal["modbus"] = Field(description="kind of this source")
    profile: str | None = Field(
        default=None, description=f"device whose registers are known: {', '.join(MODBUS_PROFILES)}"
    )
    host: str | None = Field(default=None, description="Modbus TCP: host name or address of the device or gateway")
    tcp_port: Annotated[int, Field(ge=1, le=65535)] = Field(default=502, description="Modbus TCP: port of host")
    port: str | None = Field(
        default=None, description="Modbus RTU: path of the serial port, preferably below /dev/serial/by-id"
    )
    baud: Annotated[int, Field(ge=300, le=4_000_000)] = Field(default=9600, description="Modbus RTU: baud rate")
    parity: Literal["none", "even", "odd"] = Field(default="none", description="Modbus RTU: parity bit")
    stop_bits: Literal[1, 2] = Field(default=1, description="Modbus RTU: number of stop bits")
    framing: Literal["tcp", "rtu"] | None = Field(
        default=None,
        description='"rtu" with host: the gateway forwards serial frames unchanged; default: "tcp" with host, "rtu" with port',
    )
    unit: Annotated[int, Field(ge=0, le=255)] = Field(
        default=1, description="Modbus unit number (address) of the device"
    )
    poll_s: Annotated[float, Field(ge=0.02, le=600)] = Field(default=1.0, description="interval between two readings")
    timeout_s: Annotated[float, Field(ge=0.05, le=60)] = Field(default=1.0, description="timeout of each response")
    voltage: Register = Field(
        description='register of the pack voltage, such as { address = 259, type = "uint16", scale = 0.01 }'
    )
    current: Register = Field(
        description="register of the current, written like voltage; sensor.current_sign is the direction of positive current"
    )
    temperature: Annotated[tuple[Register, ...], BeforeValidator(as_tuple)] = Field(
        default=(), description="register of the temperature, written like voltage; a list for several probes"
    )
    soc: Register | None = Field(
        default=None,
        description="register of the SOC that the device reports [%], written like voltage; it is shown beside the estimate",
    )
    capacity: Register | None = Field(
        default=None,
        description="register of the capacity from which the device computes its SOC [Ah], written like voltage",
    )
    cells: CellRegisters | None = Field(
        default=None,
        description="register of the first cell's voltage, written like voltage, with count, the number of cells; step is the distance between two cells if registers are not consecutive",
    )

    @model_validator(mode="before")
    @classmethod
    def _merge_profile(cls, table: object) -> object:
        return merge_profile(table, MODBUS_PROFILES)

    @model_validator(mode="after")
    def _check_host_and_port(self) -> Self:
        if (self.host is None) == (self.port is None):
            raise ValueError("give either host for Modbus TCP, or port for a serial line")
        if self.port is not None and self.framing == "tcp":
            raise ValueError('framing: a serial line always uses "rtu"; remove framing, or give host for "tcp"')
        return self

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]."""
        return self.poll_s

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        address = f"{self.host}:{self.tcp_port}" if self.port is None else self.port
        return f"Modbus unit {self.unit} at {address}"

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults: sign of a known device, and resolution of integer values."""
        sign = {"current_sign": "charge_positive"} if self.profile else {}
        volts = {} if self.voltage.type == "float32" else {"voltage_resolution_v": abs(self.voltage.scale)}
        amperes = {} if self.current.type == "float32" else {"current_resolution_a": abs(self.current.scale)}
        return {**sign, **volts, **amperes}
