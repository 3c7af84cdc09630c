"""Reader and writer of a fleet's table of packs, a CSV file with one row per pack.

An error text names the line, the column and a remedy.
"""

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from bms_estimator.fleet.packs.pack_row import COLUMNS, PackSpec, encode_row, model_key, model_of, shipped_cell_names
from bms_estimator.model.config_file import error_reason, suggestion
from bms_estimator.model.errors import UserError
from bms_estimator.settings.pack import DEVICE_NAME

MAX_ERRORS = 20
"""Maximum number of reported errors of a table."""
CELL_FILE_SUFFIX = ".toml"
"""Suffix in column ``cell`` that marks the name of a cell file beside the table."""
_INTEGER_COLUMNS = ("series", "parallel")
_TEXT_COLUMNS = ("pack", "cell", "protocol")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


class Line(NamedTuple):
    """A row of the table."""

    number: int
    """Number of the line in the file."""
    spec: PackSpec
    data: bytes
    """Row as ``encode_row`` encodes it."""


@dataclass(frozen=True)
class PackTable:
    """Content of a table.

    Attributes:
        packs: Rows by pack name.
        cell_files: Paths of the named cell files, by cell name.
    """

    packs: Mapping[str, Line]
    cell_files: Mapping[str, Path]


class _RowError(ValueError):
    """Error in one value; the message names the column and a remedy."""


def read_table(path: Path) -> PackTable:
    """Read a table of packs.

    The first line names the columns, separated by ``,`` or ``;``. The columns ``pack`` and ``cell`` are required.

    Raises:
        UserError: The file cannot be read; or a line for each wrong value, at most ``MAX_ERRORS``.
    """
    return _Reader(path).table()


def check_models(path: Path, table: PackTable, cell_files: Mapping[str, str]) -> None:
    """Check that each specification has a valid cell model.

    Args:
        path: Path of the table, for error texts.
        table: Result of ``read_table``.
        cell_files: Texts of the cell files by cell name.

    Raises:
        UserError: A line of text for each specification without a valid model, with the number of its first line in the table.
    """
    lines_by_model = dict[tuple[object, ...], list[Line]]()
    for line in table.packs.values():
        lines_by_model.setdefault(model_key(line.spec), []).append(line)
    errors = []
    for lines in lines_by_model.values():
        first = lines[0]
        try:
            model_of(first.spec, cell_files.get(first.spec.cell))
        except UserError as error:
            others = f", and {len(lines) - 1} more like this" if len(lines) > 1 else ""
            errors.append(f"{path}: line {first.number}{others}: {error}")
    _raise_errors(path, errors)


class _Reader:
    """Reader of one table."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._specs = dict[
            tuple[str, ...], tuple[PackSpec, bytes]
        ]()  # parsed and encoded, by the values without the name
        self._files = dict[str, Path]()

    def table(self) -> PackTable:
        """Read and return the table. Errors are those of ``read_table``."""
        rows = csv.reader(io.StringIO(text := self._text(), newline=""), delimiter=_separator(text), strict=True)
        packs, errors = dict[str, Line](), list[str]()
        try:
            columns = self._columns(next(rows, []))
            for values in rows:
                if not any(value.strip() for value in values):
                    continue
                try:
                    name, spec, data = self._row(columns, [value.strip() for value in values])
                    _reject_duplicate(name, packs)
                    packs[name] = Line(rows.line_num, spec, data)
                except _RowError as error:
                    errors.append(f"{self._path}: line {rows.line_num}, {error}")
        except csv.Error as error:
            errors.append(f"{self._path}: line {rows.line_num}: {error}; a quote that is opened must be closed")
        _raise_errors(self._path, errors)
        if not packs:
            raise UserError(f"{self._path}: no row below the line of column names; add one for each pack")
        return PackTable(packs, self._files)

    def _text(self) -> str:
        try:
            return self._path.read_text(encoding="utf-8-sig")
        except OSError as error:
            raise UserError(f"{self._path}: cannot be read: {error.strerror}") from None
        except UnicodeDecodeError as error:
            raise UserError(f"{self._path}: not UTF-8 (byte {error.start}); save it as CSV in UTF-8") from None

    def _columns(self, header: Sequence[str]) -> list[str]:
        """Return the columns named in the first line.

        Raises:
            UserError: A column is unknown, repeated or missing.
        """
        names = [name.strip() for name in header]
        all_columns = f"; there are {', '.join(COLUMNS)}"
        errors = [
            f"column {name!r} is unknown{suggestion(name, COLUMNS) or all_columns}"
            for name in names
            if name not in COLUMNS
        ]
        errors += [f"column {name} is repeated" for name in COLUMNS if names.count(name) > 1]
        errors += [f"column {name} is missing" for name in ("pack", "cell") if name not in names]
        _raise_errors(self._path, [f"{self._path}: line 1: {error}" for error in errors])
        return names

    def _row(self, columns: list[str], values: list[str]) -> tuple[str, PackSpec, bytes]:
        if len(values) != len(columns):
            raise _RowError(f"{len(values)} values in {len(columns)} columns; give one for each, empty for the default")
        index = columns.index("pack")
        name = values[index]
        if not re.fullmatch(DEVICE_NAME, name):
            raise _RowError(_error_text("pack", name, "must be 1 to 64 letters, digits, _ and -"))
        key = (*values[:index], *values[index + 1 :])
        if key not in self._specs:
            nonempty = {
                column: value for column, value in zip(columns, values, strict=True) if value and column != "pack"
            }
            spec = self._spec(nonempty)
            self._specs[key] = spec, encode_row(spec)
        return name, *self._specs[key]

    def _spec(self, nonempty: Mapping[str, str]) -> PackSpec:
        """Return the specification in the nonempty columns."""
        values: dict[str, object] = {column: _value(column, value) for column, value in nonempty.items()}
        cell = nonempty.get("cell", "")
        if cell.endswith(CELL_FILE_SUFFIX):
            values["cell"] = self._cell_file(cell)
        try:
            return PackSpec.model_validate(values)
        except ValidationError as error:
            detail = error.errors()[0]
            message = error_reason(detail)
            if not detail["loc"]:  # a contradiction between columns, which the message names
                raise _RowError(f"column {message}") from None
            column = str(detail["loc"][0])
            description = PackSpec.model_fields[column].description
            if column not in nonempty:
                raise _RowError(f"column {column} is empty; it must be {description}") from None
            raise _RowError(_error_text(column, nonempty[column], f"{message} ({description})")) from None

    def _cell_file(self, value: str) -> str:
        """Check the file of a cell and return the cell's name."""
        path = self._path.parent / value
        name = path.name.removesuffix(CELL_FILE_SUFFIX)
        if not path.is_file():
            raise _RowError(_error_text("cell", value, f"no such file beside the table ({path})"))
        if not re.fullmatch(DEVICE_NAME, name):
            raise _RowError(
                _error_text("cell", value, "its name before .toml must be 1 to 64 letters, digits, _ and -")
            )
        if name in shipped_cell_names():
            raise _RowError(_error_text("cell", value, f"{name} is a cell of the package; give the file another name"))
        if not self._files.setdefault(name, path).samefile(path):
            raise _RowError(_error_text("cell", value, f"another file of this name is {self._files[name]}; rename one"))
        return name


def _reject_duplicate(name: str, packs: Mapping[str, Line]) -> None:
    if name in packs:
        raise _RowError(_error_text("pack", name, f"is already on line {packs[name].number}; remove one of them"))


def _value(column: str, value: str) -> object:
    if column in _TEXT_COLUMNS:
        return value
    if not _NUMBER.fullmatch(value):
        hint = ", with a point and not a comma" if "," in value else ""
        raise _RowError(_error_text(column, value, f"must be a number{hint}"))
    return int(value) if column in _INTEGER_COLUMNS and value.isdecimal() else float(value)


def _error_text(column: str, value: str, error: str) -> str:
    return f"column {column} = {value!r}: {error}"


def _separator(text: str) -> str:
    """Return the separator: the more frequent candidate in the first line."""
    first = text.partition("\n")[0]
    return max(",;", key=first.count)


def _raise_errors(path: Path, errors: Sequence[str]) -> None:
    if errors:
        omitted = len(errors) - MAX_ERRORS
        raise UserError("\n".join([*errors[:MAX_ERRORS], *([f"{path}: and {omitted} more"] if omitted > 0 else [])]))


def table_lines(packs: Mapping[str, PackSpec]) -> Iterator[str]:
    """Yield the table as CSV lines with line ends; empty columns are omitted."""
    rows = {name: spec.model_dump(exclude_defaults=True) for name, spec in sorted(packs.items())}
    columns = [column for column in COLUMNS if column == "pack" or any(column in row for row in rows.values())]
    yield ",".join(columns) + "\n"
    for name, row in rows.items():
        yield ",".join(str(({"pack": name} | row).get(column, "")) for column in columns) + "\n"
