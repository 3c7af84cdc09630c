"""Registers of a Modbus device: ``[source]`` with ``kind = "modbus"``."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.sources.source import BaseSource, as_tuple, merge_profile

MAX_WORDS = 125
"""Maximum number of registers, which are 16-bit words, in a request (Modbus application protocol V1.1b3, section 6.3)."""
ADDRESS_END = 0x10000
"""First address beyond the last register, 65535."""
WORDS = {"int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "float32": 2}
"""Number of registers of a value, by its type."""
PROFILES: dict[str, dict[str, object]] = {
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
    profile: str | None = Field(default=None, description=f"device whose registers are known: {', '.join(PROFILES)}")
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
        return merge_profile(table, PROFILES)

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
