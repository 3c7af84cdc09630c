"""Model of a pack, a battery or a fuel cell stack, the only place that decides between them; and the writer of cell files.

The values of a fuel cell file describe ``series_count`` cells in series as one two-terminal object. ``FuelCellModel.pack`` scales them to
several such stacks. A fuel cell has no capacity and no SOC.
"""

import math
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NoReturn

import numpy as np
import tomlkit
from numpy.typing import NDArray
from pydantic import Field

from bms_estimator.model.cell import (
    CellModel,
    Rated,
    Result,
    cell_file_path,
    is_fuel_cell,
    load_cell,
    shipped_fuel_cells,
)
from bms_estimator.model.cell_sections import ELEMENTS
from bms_estimator.model.config_file import NotNegative, Positive, Strict, read_toml, write_text
from bms_estimator.model.errors import UserError

Parameter = Literal[
    "r_ohm",
    "tafel_slope_v",
    "exchange_current_a",
    "c_dl_farad",
    "concentration_v",
    "limiting_current_a",
    "internal_current_a",
]
"""Identified parameters of a stack, in the order of ``kernels.cell_model.fuel_cell.NAMES``."""
CONSTANTS = 16
"""Length of an array with the kernels' constants."""
MAX_CURRENT_RATIO = 10.0
"""Highest possible current of a fuel cell in multiples of its maximum current. Its limiting current density is lower."""


class FuelCell(Strict):
    """Parameters of a stack: losses of all its cells in series, and gas supply."""

    r_ohm: Positive = Field(description="resistance of membrane and contacts")
    tafel_slope_v: Positive = Field(
        description="Tafel slope: increase of the activation loss if the current increases by a factor of e"
    )
    # below 1 A, so that the activation loss at 1 A is positive; the logarithm of this loss is learned
    exchange_current_a: Annotated[float, Field(gt=0, lt=1)] = Field(
        description="current at which Tafel's line has an activation loss of 0 V"
    )
    c_dl_farad: Positive = Field(description="capacitance of the double layer")
    concentration_v: Positive = Field(description="B of the concentration loss -B ln(1 - i / limiting_current_a)")
    limiting_current_a: Positive = Field(description="maximum current that the gas supply of the electrodes allows")
    internal_current_a: Positive = Field(
        description="current equivalent to the gas that crosses the membrane, also at no load"
    )
    temperature_c: Annotated[float, Field(gt=-40, lt=200)] = Field(
        description="temperature of the values, and assumed temperature of a stack without a sensor"
    )
    hydrogen_atm: Positive = Field(description="partial pressure at the anode")
    oxygen_atm: Positive = Field(description="partial pressure at the cathode; 0.21 in air at 1 atm")


class FuelCellModel(Strict):
    """Contents of a fuel cell file."""

    cell: Rated
    fuel_cell: FuelCell
    std: dict[Parameter, NotNegative] = Field(
        default_factory=dict, description="relative standard deviations of values that were identified"
    )

    @property
    def a(self) -> NDArray[np.float64]:
        """Constants of the kernels, shape (16,), as for a1..a15 of a battery cell.

        Index 1..7: parameters in the order of ``kernels.cell_model.fuel_cell.NAMES``. Index 8..11: cells in series,
        temperature [C], partial pressures of hydrogen and oxygen [atm]. All other elements are 0 and not used.
        """
        f = self.fuel_cell
        losses = (f.r_ohm, f.tafel_slope_v, self.activation_v, f.c_dl_farad, f.concentration_v)
        currents = (f.limiting_current_a, f.internal_current_a)
        conditions = (self.cell.series_count, f.temperature_c, f.hydrogen_atm, f.oxygen_atm)
        constants = np.zeros(CONSTANTS)
        constants[1:12] = *losses, *currents, *conditions
        return constants

    no_forecast_reason: ClassVar[str] = "a fuel cell has no state of charge"
    """Reason why the estimator of this model makes no forecasts."""
    always_learns: ClassVar[bool] = True
    """True: the observer uses the law ``learning``, whatever is configured."""
    min_voltage_ratio: ClassVar[float] = 0.0
    """Minimum voltage relative to the nominal voltage. A stack without gas has 0 V."""

    def by_kind(self, _battery: object, stack: Callable[["FuelCellModel"], Result]) -> Result:
        """Return ``stack(self)``. The model of a battery calls the first function instead."""
        return stack(self)

    def battery(self, error: str) -> NoReturn:
        """Reject this model where a battery is needed.

        Raises:
            UserError: Always, with the text ``error``.
        """
        raise UserError(error)

    @property
    def capacity_ah(self) -> None:
        """Rated capacity: a fuel cell has none."""

    @property
    def capacity_text(self) -> str:
        """Kind of the model, in place of a capacity."""
        return "fuel cell"

    @property
    def one_c_a(self) -> float:
        """Reference of C-rates, the maximum current, because a fuel cell has no capacity [A]."""
        return self.cell.current_max_a

    @property
    def possible_a(self) -> float:
        """Highest possible current [A]."""
        return MAX_CURRENT_RATIO * self.cell.current_max_a

    def state_basis(self, current_sign: str) -> tuple[float | str, ...]:
        """Return all numbers on which the meaning of a saved state depends. Learned values are relative to all parameters."""
        return (*self.a, current_sign)

    @property
    def activation_v(self) -> float:
        """Activation loss at 1 A [V]: parameter a of Tafel's line a + A ln i."""
        return -self.fuel_cell.tafel_slope_v * math.log(self.fuel_cell.exchange_current_a)

    def identified(self, a: NDArray[np.float64], std: dict[Parameter, float]) -> "FuelCellModel":
        """Return the stack with identified parameters.

        Args:
            a: Constants in the order of the property ``a``. Only the parameters are used.
            std: Relative standard deviations of the identified parameters.
        """
        r_ohm, tafel_v, activation_v, c_dl, b, limit, internal = (float(f"{value:.6g}") for value in a[1:8])
        values = {
            "r_ohm": r_ohm,
            "tafel_slope_v": tafel_v,
            "exchange_current_a": float(f"{math.exp(-activation_v / tafel_v):.6g}"),
            "c_dl_farad": c_dl,
            "concentration_v": b,
            "limiting_current_a": limit,
            "internal_current_a": internal,
        }
        fuel_cell = FuelCell.model_validate(self.fuel_cell.model_dump() | values)
        rounded_std = {name: float(f"{value:.2g}") for name, value in std.items()}
        return self.model_copy(update={"fuel_cell": fuel_cell, "std": rounded_std})

    def pack(self, series: int, parallel: int) -> "FuelCellModel":
        """Return the model of ``series`` x ``parallel`` stacks, with all values scaled.

        Raises:
            UserError: The exchange current is 1 A or more, so that the activation loss at 1 A is not positive.
        """
        if series == parallel == 1:
            return self
        factor = {"ohm": series / parallel, "farad": parallel / series, "v": series, "a": parallel}
        exchange_a = parallel * self.fuel_cell.exchange_current_a
        if exchange_a >= 1.0:
            raise UserError(
                f"{self.cell.name}: exchange_current_a of {parallel} in parallel is {exchange_a:g}: must be less than 1"
            )

        def scaled_by_unit(part: Strict) -> dict[str, object]:
            return {
                key: value * factor[unit] if (unit := key.rpartition("_")[2]) in factor else value
                for key, value in part.model_dump().items()
            }

        cell = scaled_by_unit(self.cell) | {"series_count": self.cell.series_count * series}
        return FuelCellModel.model_validate(
            {"cell": cell, "fuel_cell": scaled_by_unit(self.fuel_cell), "std": self.std}
        )


def load_fuel_cell(name_or_path: str | Path) -> FuelCellModel:
    """Load a shipped fuel cell by name, or a fuel cell file by path.

    Raises:
        UserError: No such name or file, or an invalid value in the file.
    """
    text = str(name_or_path)
    if text not in shipped_fuel_cells():
        return read_toml(cell_file_path(text), FuelCellModel)
    with resources.as_file(resources.files("bms_estimator.model") / f"cells/fuel_cell/{text}.toml") as path:
        return read_toml(path, FuelCellModel)


PackModel = CellModel | FuelCellModel
"""Model of a pack of batteries or of fuel cell stacks."""


def load_model(name_or_path: str | Path, capacity_ah: float | None = None) -> PackModel:
    """Load a battery cell (``load_cell``) or a fuel cell (``load_fuel_cell``).

    Raises:
        UserError: No such cell or file, an invalid value, or a capacity for a fuel cell.
    """
    if not is_fuel_cell(name_or_path):
        return load_cell(name_or_path, capacity_ah)
    if capacity_ah is not None:
        raise UserError(f"{name_or_path} is a fuel cell, which has no capacity: leave out capacity_ah")
    return load_fuel_cell(name_or_path)


EQUATIONS = {"r_ts": "(2.5)", "r_tl": "(2.6)", "c_ts": "(2.7)", "c_tl": "(2.8)", "r_s": "(2.9)"}
"""Equation of the thesis for each section, for the section's comment."""
LINE_VALUES = 8
"""Number of values on a line of a list."""
DIGITS = 8
"""Number of significant digits of a written number. The rounding error of a cell's voltage is below 0.1 uV."""


def write_cell(path: str | Path, cell: PackModel, remarks: Sequence[str] = ()) -> None:
    """Write a cell file that ``load_model`` reads.

    Args:
        path: Path of the file, which is overwritten if it exists.
        cell: Cell model. Its numbers are rounded to ``DIGITS`` significant digits.
        remarks: Origin of the values, one line each, for the head of the file.

    Raises:
        UserError: The file cannot be written.
    """
    write_text(Path(path), cell_text(cell, remarks))


def cell_text(cell: PackModel, remarks: Sequence[str] = ()) -> str:
    """Return the text of a cell file."""
    document = tomlkit.document()
    for remark in remarks:
        document.add(tomlkit.comment(remark))
    for name, values in cell.model_dump(mode="json", exclude_none=True).items():
        if not values:
            continue
        section = _bounds(values) if name == "adaptation" else _section(values)
        document.add(name, section)
        if name in ELEMENTS:
            first = ELEMENTS[name][0]
            section.comment(f"{EQUATIONS[name]} a{first}, a{first + 1}, a{first + 2}")
    return tomlkit.dumps(document).rstrip() + "\n"


def _section(values: dict[str, object]) -> tomlkit.items.Table:
    section = tomlkit.table()
    for key, value in values.items():
        section.add(key, _value(value))
    section.add(tomlkit.nl())
    return section


def _bounds(values: dict[str, dict[str, object]]) -> tomlkit.items.Table:
    """Return the section ``[adaptation]`` with one line for each parameter."""
    section = tomlkit.table()
    for parameter, bounds in values.items():
        line = tomlkit.inline_table()
        line.update({key: _value(value) for key, value in bounds.items()})
        section.add(parameter, line)
    section.add(tomlkit.nl())
    return section


def _value(value: object) -> object:
    """Return a value for TOML. Numbers are rounded, and lists are divided into lines."""
    if isinstance(value, list):
        array = tomlkit.array()
        if value and isinstance(value[0], list):  # a matrix: one line for each row
            for row in value:
                line = tomlkit.array()
                line.extend(_value(x) for x in row)
                array.add_line(line)
            array.add_line(indent="")
            return array
        for i in range(0, len(value), LINE_VALUES):
            array.add_line(*(_value(x) for x in value[i : i + LINE_VALUES]))
        array.add_line(indent="")
        return array
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
