"""Model of a pack: the only place that decides between batteries and fuel cell stacks, and the writer of cell files."""

from collections.abc import Sequence
from pathlib import Path

import tomlkit

from bms_estimator.model.cell import ELEMENTS, CellModel, is_fuel_cell, load_cell
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import FuelCellModel, load_fuel_cell

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
