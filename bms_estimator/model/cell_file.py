"""Writing a cell file: every command that finds out something about a cell writes it with ``write_cell``."""

from collections.abc import Sequence
from pathlib import Path

import tomlkit

from bms_estimator.model.cell import ELEMENTS
from bms_estimator.model.config_file import write_text
from bms_estimator.model.fuel_cell import PackModel

SOURCES = {"r_ts": "(2.5)", "r_tl": "(2.6)", "c_ts": "(2.7)", "c_tl": "(2.8)", "r_s": "(2.9)"}
"""Section -> its equation."""
DIGITS = 8
"""Significant digits: a hundredth of a microvolt of a cell's voltage."""


def write_cell(path: Path, cell: PackModel, remarks: Sequence[str] = ()) -> None:
    """Write a cell file that ``load_any`` reads.

    Args:
        path: Overwritten if it exists.
        cell: Numbers are rounded to ``DIGITS`` significant ones.
        remarks: Origin of the values, one line each, for the head of the file.

    Raises:
        UserError: The file cannot be written.
    """
    write_text(path, cell_text(cell, remarks))


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
            section.comment(f"{SOURCES[name]} a{first}, a{first + 1}, a{first + 2}")
    return tomlkit.dumps(document).rstrip() + "\n"


def _section(values: dict[str, object]) -> tomlkit.items.Table:
    section = tomlkit.table()
    for key, value in values.items():
        section.add(key, _value(value))
    section.add(tomlkit.nl())
    return section


def _bounds(values: dict[str, dict[str, object]]) -> tomlkit.items.Table:
    """``[adaptation]``: one parameter, one line."""
    section = tomlkit.table()
    for parameter, bounds in values.items():
        line = tomlkit.inline_table()
        line.update({key: _value(value) for key, value in bounds.items()})
        section.add(parameter, line)
    section.add(tomlkit.nl())
    return section


def _value(value: object) -> object:
    """Format a value as TOML: rounded; a long list over several lines."""
    if isinstance(value, list):
        array = tomlkit.array()
        if value and isinstance(value[0], list):  # a table: one row, one line
            for row in value:
                line = tomlkit.array()
                line.extend(_value(x) for x in row)
                array.add_line(line)
            array.add_line(indent="")
            return array
        for i in range(0, len(value), 8):
            array.add_line(*(_value(x) for x in value[i : i + 8]))
        array.add_line(indent="")
        return array
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
