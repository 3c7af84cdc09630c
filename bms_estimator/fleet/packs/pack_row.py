"""Row of the table of packs, and the settings and model that follow from it.

On the server the key of a row is its pack's name, and the value is JSON without the name, so that packs of one kind
have equal bytes.
"""

import tomllib
from typing import Annotated

from pydantic import Field, ValidationError

from bms_estimator.model.cell import (
    CellModel,
    generic_cells,
    shipped_cells,
    shipped_fuel_cells,
    with_capacity,
)
from bms_estimator.model.config_file import Fraction, NotNegative, Positive, Strict, parse_toml
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import FuelCellModel, PackModel, load_any
from bms_estimator.model.one_of import OneOf
from bms_estimator.protocols.registry import DEVICES
from bms_estimator.settings.pack import DeviceName, PackSettings, Settings
from bms_estimator.settings.sensor import SensorSettings

CELL_NAME = r"^[A-Za-z0-9_-]{1,80}$"
"""Pattern of a cell's name; a cell file of one pack has a longer name than the pack."""
_COUNT = Field(ge=1, le=10_000)


class PackSpec(Strict):
    """Values that packs of one kind share; as ``[pack]`` and ``[sensor]`` of a pack's file."""

    cell: Annotated[str, Field(pattern=CELL_NAME)] = Field(
        description="lfp, nmc, nca, lco, lmo, lto: generic, give capacity_ah; else a shipped cell's name, or a cell "
        "file's beside the table, which must end in .toml"
    )
    capacity_ah: Positive | None = Field(
        default=None, description="what one cell-file object holds; that of the cell file when left out"
    )
    series: Annotated[int, _COUNT] = Field(default=1, description="cell-file objects in series")
    parallel: Annotated[int, _COUNT] = Field(default=1, description="cell-file objects in parallel")
    initial_soc: Fraction | None = Field(default=None, description="SOC 0..1 at start; from the OCV when left out")
    protocol: Annotated[str, OneOf(DEVICES)] = Field(
        default="text", description="the BMS or meter that measures: what it resolves, where no column says otherwise"
    )
    voltage_resolution_v: Positive | None = Field(default=None, description="one step of the pack's voltage")
    voltage_noise_v: NotNegative | None = Field(
        default=None, description="standard deviation of one voltage sample; half a step when left out"
    )
    current_resolution_a: NotNegative | None = Field(default=None, description="one step of the current")
    current_dead_band_a: NotNegative | None = Field(default=None, description="smaller currents are shown as 0")
    period_s: Positive | None = Field(default=None, description="between two samples; 1 s when left out")


class PackRow(PackSpec):
    """One pack."""

    pack: DeviceName = Field(description="device in topic names: 1 to 64 letters, digits, _ and -")

    @property
    def kind(self) -> PackSpec:
        """All but the name."""
        return PackSpec.model_validate(self.model_dump(exclude={"pack"}, exclude_unset=True))


COLUMNS = ("pack", *PackSpec.model_fields)
"""Columns of a table, in the order in which they are written."""


def stored(kind: PackSpec) -> bytes:
    """Encode a pack's row for the server; equal values give equal bytes."""
    return kind.model_dump_json(exclude_defaults=True).encode()


def kind_of(data: bytes) -> PackSpec:
    """Decode a row encoded by ``stored``.

    Raises:
        ValueError: It did not; the message gives the reason.
    """
    try:
        return PackSpec.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        message = first["msg"].removeprefix("Value error, ")
        raise ValueError(f"{where}: {message}" if where else message) from None


def settings_of(row: PackSpec) -> Settings:
    """Return the settings of a pack; those of a kind have the default name."""
    told = row.model_dump(exclude_none=True)
    if isinstance(row, PackRow):
        told["name"] = row.pack
    pack, sensor = (
        {name: told[name] for name in section.model_fields if name in told}
        for section in (PackSettings, SensorSettings)
    )
    return Settings(pack=PackSettings.model_validate(pack), sensor=SensorSettings.model_validate(sensor))


def known_cells() -> tuple[str, ...]:
    """Names of all shipped cells."""
    return (*shipped_cells(), *generic_cells(), *shipped_fuel_cells())


def model_of(kind: PackSpec, cell_file: str | None) -> PackModel:
    """Return the pack as one object.

    Args:
        kind: Names the cell, its capacity and its number.
        cell_file: Text of the loaded file of that name; None without one. A shipped cell takes precedence.

    Raises:
        UserError: There is no such cell, or a value in it that is not allowed; a capacity that is missing or cannot be.
    """
    return cell_of(kind, cell_file).pack(kind.series, kind.parallel)


def model_key(kind: PackSpec) -> tuple[object, ...]:
    """Kinds with the same one have a model all of them, or none of them has."""
    return kind.cell, kind.capacity_ah is None, kind.series, kind.parallel


def cell_of(kind: PackSpec, cell_file: str | None) -> PackModel:
    """Return one of the objects that the pack consists of; as ``model_of``."""
    name = kind.cell
    if name in known_cells():
        return load_any(name, kind.capacity_ah)
    if cell_file is None:
        raise UserError(
            f"{name}: no cell file of this name was loaded, and the package's are {', '.join(known_cells())}"
        )
    if not _is_fuel_cell(cell_file):
        cell = parse_toml(cell_file, CellModel, f"cell {name}")
        return cell if kind.capacity_ah is None else with_capacity(cell, kind.capacity_ah)
    if kind.capacity_ah is not None:
        raise UserError(f"{name} is a fuel cell, which has no capacity: leave out capacity_ah")
    return parse_toml(cell_file, FuelCellModel, f"cell {name}")


def _is_fuel_cell(cell_file: str) -> bool:
    try:
        return "fuel_cell" in tomllib.loads(cell_file)
    except (ValueError, RecursionError):
        return False  # the reader of the cell file reports errors
