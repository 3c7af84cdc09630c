"""Captures as tables: CSV, gzipped CSV and Parquet, read in blocks so that memory does not grow with the file.

Two spellings of the columns are supported: this project's, and that of the Battery Data Format, which is positive on
charge.
"""

import csv
import gzip
import itertools
import zlib
from collections.abc import Iterator, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import IO, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bms_estimator.model.decimal_text import measured
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import MAX_C, MIN_C, SAMPLE, CurrentSign, SampleBlock, remove_implausible

BLOCK_ROWS = 65_536
"""Maximum number of rows of a block."""
MAX_SHOWN_CHARACTERS = 40
"""Maximum number of characters of an invalid number that are shown."""


class ColumnNaming(NamedTuple):
    """Column names of ``SAMPLE`` in a table, and the sign of its current."""

    time_s: str
    current_a: str
    voltage_v: str
    temperature_c: str
    current_sign: CurrentSign | None
    """Direction of positive current; None if the column names do not define it."""

    @property
    def required(self) -> tuple[str, str, str]:
        """Names of the columns that a table must have."""
        return self.time_s, self.current_a, self.voltage_v


NAMINGS = (
    ColumnNaming("time_s", "current_a", "voltage_v", "temperature_c", None),
    ColumnNaming("Test Time / s", "Current / A", "Voltage / V", "Surface Temperature / degC", "charge_positive"),
)
"""This project's columns, and those of the Battery Data Format."""


class Sign(NamedTuple):
    """Direction of positive current in a table."""

    configured: CurrentSign | None = None
    """Configured direction, which takes precedence over the column names; None: not configured."""
    default: CurrentSign = "discharge_positive"
    """Default direction if neither ``configured`` nor the column names define one."""

    def factor(self, naming: ColumnNaming) -> float:
        """Return the factor, 1 or -1, that makes discharge positive."""
        return 1.0 if (self.configured or naming.current_sign or self.default) == "discharge_positive" else -1.0


class ColumnTable(Protocol):
    """Table in memory, such as a dict of arrays or a DataFrame."""

    def __iter__(self) -> Iterator[str]:
        """Yield the names of the columns."""

    def __getitem__(self, name: str, /) -> ArrayLike:
        """Return a column."""


class _Columns(NamedTuple):
    """Columns of a sample in a table."""

    indices: tuple[int, ...]
    """Column indices of time, current, voltage, and of temperature and status if there are such columns."""
    names: tuple[str, ...]
    discharge_sign: float


class CsvTable:
    """Reader of a CSV file, gzipped if its name ends in .gz. Lines that start with # are comments.

    Args:
        path: The file.
        sign: Direction of positive current.
    """

    def __init__(self, path: Path, sign: Sign) -> None:
        self._path, self._sign = path, sign
        self.implausible = 0
        self._raw: IO[bytes] | None = None
        self._size = 0

    @property
    def fraction(self) -> float:
        """Fraction of the file that has been read, 0..1."""
        if self._raw is None:
            return 0.0
        return 1.0 if self._raw.closed else self._raw.tell() / max(self._size, 1)

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of at most ``BLOCK_ROWS`` samples, with the current positive on discharge.

        Raises:
            UserError: The file cannot be read; the message names file, line and column.
        """
        try:
            with self._path.open("rb") as self._raw:
                self._size = self._path.stat().st_size
                packed = self._path.name.lower().endswith(".gz")
                plain = cast("IO[bytes]", gzip.GzipFile(fileobj=self._raw)) if packed else self._raw
                with TextIOWrapper(plain, encoding="utf-8-sig") as text:
                    yield from self._blocks(text)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise UserError(f"{self._path}: gzip data damaged or cut short: {error}") from None
        except UnicodeDecodeError:
            raise UserError(f"{self._path}: not a text file, though its name says CSV") from None
        except OSError as error:
            raise UserError(f"{self._path}: cannot be read: {error.strerror}") from None

    def _blocks(self, text: TextIOWrapper) -> Iterator[SampleBlock]:
        header, line = _read_header(self._path, text)
        columns = _find_columns(self._path, header, self._sign)
        rows = 0
        while lines := list(itertools.islice(text, BLOCK_ROWS)):
            values = self._values(lines, line + 1, columns, len(header))
            line += len(lines)
            if len(values):
                rows += len(values)
                block, implausible = _make_block(values.T, columns)
                self.implausible += implausible
                yield block
        if rows == 0:
            raise UserError(f"{self._path}: no samples after the header in line {line}")

    def _values(self, lines: Sequence[str], first_line: int, columns: _Columns, width: int) -> NDArray[np.float64]:
        """Return the values of a sample's columns in some lines, shape (rows, columns)."""
        if not any(_is_data(line) for line in lines):
            return np.empty((0, len(columns.indices)))
        try:
            return np.loadtxt(lines, delimiter=",", usecols=columns.indices, ndmin=2, quotechar='"')
        except ValueError:  # an empty cell, or an error, which is reported with line and column
            return self._values_one_by_one(lines, first_line, columns, width)

    def _values_one_by_one(
        self, lines: Sequence[str], first_line: int, columns: _Columns, width: int
    ) -> NDArray[np.float64]:
        rows = []
        for number, line in enumerate(lines, first_line):
            if not _is_data(line):
                continue
            cells = next(csv.reader([line]))
            if len(cells) <= max(columns.indices):
                raise UserError(f"{self._path}: line {number}: {len(cells)} values, but the header has {width} columns")
            indices_by_name = zip(columns.names, columns.indices, strict=True)
            rows.append([self._number(cells[index], number, name) for name, index in indices_by_name])
        return np.array(rows)

    def _number(self, cell: str, line: int, column: str) -> float:
        """Parse a cell of a table; an empty cell, or a word such as nan, is NaN."""
        try:
            return measured(cell) if cell.strip() else np.nan
        except ValueError:
            raise UserError(
                f"{self._path}: line {line}: {column} = {cell[:MAX_SHOWN_CHARACTERS]!r}: must be a number"
            ) from None


class ParquetTable:
    """Reader of a Parquet file with pyarrow.

    Args:
        path: The file.
        sign: Direction of positive current.
    """

    def __init__(self, path: Path, sign: Sign) -> None:
        self._path, self._sign = path, sign
        self.fraction, self.implausible = 0.0, 0

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of at most ``BLOCK_ROWS`` samples, with the current positive on discharge.

        Raises:
            UserError: The file cannot be read; the message names file, line and column.
        """
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415

        try:
            with parquet.ParquetFile(self._path) as file:
                columns = _find_columns(self._path, file.schema_arrow.names, self._sign)
                if file.metadata.num_rows == 0:
                    raise UserError(f"{self._path}: no samples")
                rows = 0
                for batch in file.iter_batches(BLOCK_ROWS, columns=list(columns.names)):
                    rows += batch.num_rows
                    self.fraction = rows / file.metadata.num_rows
                    values = [self._numbers(batch.column(name), name) for name in columns.names]
                    block, implausible = _make_block(values, columns)
                    self.implausible += implausible
                    yield block
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError, UnicodeDecodeError, MemoryError) as error:
            raise UserError(f"{self._path}: not a whole Parquet file: {error}") from None
        except OSError as error:
            raise UserError(f"{self._path}: cannot be read: {error.strerror or error}") from None

    def _numbers(self, column: "pa.Array", name: str) -> NDArray[np.float64]:  # type: ignore[name-defined]  # noqa: F821
        """Convert to floats, NaN for null."""
        import pyarrow as pa  # noqa: PLC0415

        try:
            return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False))
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            raise UserError(f"{self._path}: column {name} is {column.type}: must be numbers") from None


READERS: dict[str, type[CsvTable | ParquetTable]] = {
    ".csv": CsvTable,
    ".csv.gz": CsvTable,
    ".bdf": CsvTable,
    ".bdf.gz": CsvTable,
    ".parquet": ParquetTable,
}
"""Readers of tables by file name suffix."""


def table_reader(path: Path, sign: Sign) -> CsvTable | ParquetTable | None:
    """Return the reader of ``path`` by its file name extension; None if it is not a table."""
    name = path.name.lower()
    return next((reader(path, sign) for suffix, reader in READERS.items() if name.endswith(suffix)), None)


def convert_table(table: ColumnTable, sign: Sign) -> SampleBlock:
    """Return the samples of a table in memory.

    Raises:
        UserError: A column is missing or does not contain numbers.
    """
    columns = _find_columns("the table", list(table), sign)
    return _make_block([_numeric(name, table[name]) for name in columns.names], columns)[0]


def _numeric(name: str, column: ArrayLike) -> NDArray[np.float64]:
    """Return a numeric column of a table in memory; None becomes NaN.

    Raises:
        UserError: The column contains other values than numbers.
    """
    values = np.asarray(column)
    if values.dtype.kind == "O" and all(value is None or isinstance(value, int | float) for value in values.flat):
        values = values.astype(np.float64)
    if values.dtype.kind not in "fiu" or values.ndim != 1:
        raise UserError(
            f"the table: column {name} holds {values.dtype} of shape {values.shape}: must be numbers, one a row"
        )
    return values.astype(np.float64)


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.startswith("#")


def _read_header(path: Path, text: TextIOWrapper) -> tuple[list[str], int]:
    """Return the names in the first line that is neither empty nor a comment, and the number of that line."""
    for number, line in enumerate(iter(text.readline, ""), 1):
        if _is_data(line):
            return [name.strip() for name in next(csv.reader([line]))], number
    raise UserError(f"{path}: empty: the first line must name the columns, {_header_text(NAMINGS[0])}")


def _find_columns(path: Path | str, header: Sequence[str], sign: Sign) -> _Columns:
    """Find the columns of a sample.

    Raises:
        UserError: Columns are missing; the message lists them and the existing columns.
    """
    naming = max(NAMINGS, key=lambda naming: sum(name in header for name in naming.required))
    missing = [name for name in naming.required if name not in header]
    if missing:
        raise UserError(
            f"{path}: no column {' nor '.join(missing)}; found {', '.join(header)}; "
            f"needed: {_header_text(NAMINGS[0])}, or {_header_text(NAMINGS[1])} (Battery Data Format)"
        )
    names = tuple(name for name in (*naming.required, naming.temperature_c) if name in header)
    # ``fleet capture`` writes exactly the columns of a sample; the status of another table has another meaning
    if set(header) == set(SAMPLE.names or ()):
        names += ("status",)
    return _Columns(tuple(header.index(name) for name in names), names, sign.factor(naming))


def _header_text(naming: ColumnNaming) -> str:
    return f"{','.join(naming.required)}[,{naming.temperature_c}]"


def _make_block(
    values: Sequence[NDArray[np.float64]] | NDArray[np.float64], columns: _Columns
) -> tuple[SampleBlock, int]:
    """Return the samples of a table's columns, and the number of implausible temperatures."""
    block = np.zeros(len(values[0]), dtype=SAMPLE)
    block["time_s"] = values[0]
    block["current_a"] = columns.discharge_sign * values[1]
    block["voltage_v"] = values[2]
    block["temperature_c"] = values[3] if len(values) > 3 else np.nan
    if len(values) > 4:
        block["status"] = np.nan_to_num(values[4]).clip(min=0.0)
    return block, remove_implausible(block["temperature_c"], MIN_C, MAX_C)
