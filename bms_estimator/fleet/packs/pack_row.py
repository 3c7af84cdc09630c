"""Row of the table of packs, and the settings and model computed from it.

On the server the key of a row is the pack's name. The value is JSON without the name, so that similar packs have equal
values.
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
from bms_estimator.model.config_file import NotNegative, OneOf, Positive, Strict, error_reason, parse_toml
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, PackModel, load_model
from bms_estimator.protocols.registry import DEVICES
from bms_estimator.settings.observer import IdentifierSettings, IdentifierValues
from bms_estimator.settings.pack import PackSettings, PackValues, Settings
from bms_estimator.settings.sensor import GainStd, SensorSettings

CELL_NAME = r"^[A-Za-z0-9_-]{1,80}$"
"""Pattern of a cell's name."""
FIT_INTERVAL_S = 86_400.0
"""Default maximum interval between two fits of a pack [s]."""
_SECTIONS: dict[str, type[Strict]] = {"pack": PackSettings, "sensor": SensorSettings, "identifier": IdentifierSettings}
"""Sections of a settings file whose values come from a specification."""


class _CellName(Strict):
    """Field ``cell``. pydantic lists the fields of the last base class first, and ``cell`` is to be the first column."""

    cell: Annotated[str, Field(pattern=CELL_NAME)] = Field(
        description="generic chemistry lfp, nmc, nca, lco, lmo or lto (with capacity_ah), shipped cell, or cell file "
        "beside the table, whose name ends in .toml"
    )


class PackSpec(IdentifierValues, PackValues, _CellName):
    """Specification that many packs share: values of the sections ``[pack]``, ``[identifier]`` and ``[sensor]`` of a settings file.

    The columns of ``[sensor]`` are declared here and not inherited, because their defaults depend on ``protocol``.
    """

    protocol: Annotated[str, OneOf(DEVICES)] = Field(
        default="text", description="BMS or meter; sets the default resolutions"
    )
    voltage_resolution_v: Positive | None = Field(default=None, description="resolution of the pack voltage")
    voltage_noise_v: NotNegative | None = Field(
        default=None, description="standard deviation of one voltage sample; default: half a step"
    )
    current_resolution_a: NotNegative | None = Field(default=None, description="resolution of the current")
    current_dead_band_a: NotNegative | None = Field(
        default=None, description="limit below which the device reports a current of 0"
    )
    voltage_gain_std: GainStd | None = Field(
        default=None, description="relative standard deviation of the voltage's gain; default: depends on the protocol"
    )
    current_gain_std: GainStd | None = Field(
        default=None, description="relative standard deviation of the current's gain; default: depends on the protocol"
    )
    period_s: Positive | None = Field(default=None, description="interval between two samples; default: 1 s")


COLUMNS = ("pack", *PackSpec.model_fields)
"""Columns of a table in written order."""


def encode_row(spec: PackSpec) -> bytes:
    """Encode the specification of a pack for the server. Equal specifications give equal bytes."""
    return spec.model_dump_json(exclude_defaults=True).encode()


def decode_row(data: bytes) -> PackSpec:
    """Decode a row encoded by ``encode_row``.

    Raises:
        ValueError: The bytes are not a row; the message gives the reason.
    """
    try:
        return PackSpec.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        message = error_reason(first)
        raise ValueError(f"{field}: {message}" if field else message) from None


def settings_of(row: PackSpec) -> Settings:
    """Return the settings of a pack, with the default name."""
    values = row.model_dump(exclude_none=True)
    values.setdefault("fit_interval_s", FIT_INTERVAL_S)
    return Settings.model_validate(
        {
            section: {name: values[name] for name in model.model_fields if name in values}
            for section, model in _SECTIONS.items()
        }
    )


def shipped_cell_names() -> tuple[str, ...]:
    """Return the names of all shipped cells."""
    return (*shipped_cells(), *generic_cells(), *shipped_fuel_cells())


def model_of(spec: PackSpec, cell_file: str | None) -> PackModel:
    """Return the model of a whole pack.

    Args:
        spec: Specification of the pack.
        cell_file: Text of the cell file that was uploaded under the name ``spec.cell``; None without one. A shipped cell takes
            precedence.

    Raises:
        UserError: The cell is missing or invalid, or the capacity is missing or not allowed.
    """
    return cell_of(spec, cell_file).pack(spec.series, spec.parallel)


def model_key(spec: PackSpec) -> tuple[object, ...]:
    """Return the values that decide whether a specification has a valid model."""
    return spec.cell, spec.capacity_ah is None, spec.series, spec.parallel


def cell_of(spec: PackSpec, cell_file: str | None) -> PackModel:
    """Return the model in a cell file, without ``series`` and ``parallel``. Arguments and errors are those of ``model_of``."""
    name = spec.cell
    if name in shipped_cell_names():
        return load_model(name, spec.capacity_ah)
    if cell_file is None:
        raise UserError(
            f"{name}: no cell file of this name was uploaded, and no shipped cell has this name ({', '.join(shipped_cell_names())})"
        )
    if not _is_fuel_cell(cell_file):
        cell = parse_toml(cell_file, CellModel, f"cell {name}")
        return cell if spec.capacity_ah is None else with_capacity(cell, spec.capacity_ah)
    if spec.capacity_ah is not None:
        raise UserError(f"{name} is a fuel cell, which has no capacity: leave out capacity_ah")
    return parse_toml(cell_file, FuelCellModel, f"cell {name}")


def _is_fuel_cell(cell_file: str) -> bool:
    try:
        return "fuel_cell" in tomllib.loads(cell_file)
    except (ValueError, RecursionError):
        return False  # parse_toml reports the error
