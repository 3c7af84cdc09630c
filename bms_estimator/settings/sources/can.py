"""Frames of a CAN bus with a pack's values: ``[source]`` with ``kind = "can"``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from bms_estimator.model.config_file import Strict
from bms_estimator.settings.sources.source import BaseSource, as_tuple, merge_profile

PROFILES: dict[str, dict[str, object]] = {
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
        default=None, description=f"CAN protocol whose signals are known: {', '.join(PROFILES)}"
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
            return merge_profile(table, {name: {**each, "soc": None} for name, each in PROFILES.items()})
        return merge_profile(table, PROFILES)

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
