"""Readers of tables that are stored by column: Parquet, binary files of cyclers, and arrays in memory."""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.cell_values import MAX_TEXT_CHARACTERS, CellKind, time_kind
from bms_estimator.sources.captures.tables.layout import (
    BLOCK_ROWS,
    TIME_ROLES,
    Column,
    RawBlock,
    with_column_kinds,
    without_clock,
)
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder

if TYPE_CHECKING:
    import pyarrow as pa

MICROSECONDS_PER_S = 1_000_000


class ColumnTable(Protocol):
    """Table in memory, such as a dict of arrays or a DataFrame."""

    def __iter__(self) -> Iterator[str]:
        """Yield the names of the columns."""

    def __getitem__(self, name: str, /) -> ArrayLike:
        """Return a column."""


class ArrayTable:
    """Reader of a table in memory, as one block.

    Args:
        name: Name of the table for messages.
        table: The columns.
        finder: Finder of the columns of a sample.
        description: Kind of the table for messages.

    Raises:
        UserError: A column is missing or does not contain numbers.
    """

    fraction, warning = 1.0, ""

    def __init__(
        self, name: object, table: ColumnTable, finder: LayoutFinder, description: str = "table in memory"
    ) -> None:
        self.description = description
        header = list(table)
        layout = finder.find([str(column) for column in header])
        if layout is None:
            raise finder.no_header_error()
        self.layout = without_clock(layout)  # the kind of the clock's cells is not known
        self._columns = {
            role: to_floats(name, column, table[header[column.index]]) for role, column in self.layout.columns.items()
        }

    def blocks(self) -> Iterator[RawBlock]:
        """Yield all rows."""
        yield self._columns


class ParquetTable:
    """Reader of a Parquet file with pyarrow.

    Args:
        path: The file.
        finder: Finder of the columns of a sample.

    Raises:
        UserError: The file cannot be read, or a column is missing.
    """

    description, warning = "Parquet", ""

    def __init__(self, path: Path, finder: LayoutFinder) -> None:
        self._path, self.fraction = path, 0.0
        with _open_parquet(path) as file:
            layout = finder.find(file.schema_arrow.names)
            if layout is None:
                raise finder.no_header_error()
            if file.metadata.num_rows == 0:
                raise UserError(f"{path}: no samples")
            kinds = {role: _time_kind(file, layout.columns[role]) for role in TIME_ROLES if role in layout.columns}
            self.layout = with_column_kinds(layout, kinds)

    def blocks(self) -> Iterator[RawBlock]:
        """Yield blocks of at most ``BLOCK_ROWS`` rows.

        Raises:
            UserError: The file cannot be read; the message names file and column.
        """
        names = [column.name for column in self.layout.columns.values()]
        with _open_parquet(self._path) as file:
            rows = 0
            for batch in file.iter_batches(BLOCK_ROWS, columns=names):
                block = {
                    role: _parquet_values(self._path, column, batch.column(column.name), first_row=rows + 1)
                    for role, column in self.layout.columns.items()
                }
                rows += batch.num_rows
                self.fraction = rows / file.metadata.num_rows
                yield block


@contextmanager
def _open_parquet(path: Path) -> "Iterator[pa.parquet.ParquetFile]":
    """Open a Parquet file.

    Raises:
        UserError: The file is damaged or cannot be read.
    """
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415 - optional

    try:
        with parquet.ParquetFile(path) as file:
            yield file
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, UnicodeDecodeError, MemoryError) as error:
        raise UserError(f"{path}: damaged, or not a Parquet file: {error}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None


def _time_kind(file: "pa.parquet.ParquetFile", column: Column) -> CellKind:
    """Return the kind of the cells in the time column, by its type; if it is text, by its first cell."""
    import pyarrow as pa  # noqa: PLC0415 - optional

    column_type = file.schema_arrow.field(column.index).type
    if pa.types.is_timestamp(column_type):
        return CellKind.DATE_TIME
    if not _is_text(column_type):
        return CellKind.NUMBER
    batches = file.iter_batches(columns=[column.name])
    return time_kind(cell for batch in batches for cell in batch.column(0).to_pylist() if cell)


def _is_text(column_type: "pa.DataType") -> bool:
    from pyarrow import types  # noqa: PLC0415 - optional

    return bool(types.is_string(column_type) or types.is_large_string(column_type) or types.is_dictionary(column_type))


def _parquet_values(path: Path, column: Column, values: "pa.Array", first_row: int) -> NDArray[np.float64]:
    """Convert a column to floats; null becomes NaN.

    Raises:
        UserError: The column contains values of another type.
    """
    import pyarrow as pa  # noqa: PLC0415 - optional

    if column.kind is not CellKind.NUMBER and _is_text(values.type):
        return parse_column(path, column, values.to_pylist(), first_row)
    try:
        if pa.types.is_timestamp(values.type):
            stamps_us = values.cast(pa.timestamp("us", tz=values.type.tz)).cast(pa.int64()).cast(pa.float64())
            return np.asarray(stamps_us.to_numpy(zero_copy_only=False)) / MICROSECONDS_PER_S
        if column.kind is CellKind.DIRECTION:  # a column of numbers does not state the direction
            return np.zeros(len(values))
        return np.asarray(values.cast(pa.float64()).to_numpy(zero_copy_only=False))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        if column.is_lenient:
            return np.full(len(values), np.nan)
        raise UserError(f"{path}: column {column.name} is {values.type}: must be numbers") from None


def parse_column(path: object, column: Column, cells: list[str | None], first_row: int = 1) -> NDArray[np.float64]:
    """Parse a column of text; None becomes NaN. ``first_row`` is the row of the first cell, for messages.

    Raises:
        UserError: A cell is not valid; the message names its row.
    """
    parse = column.parser(decimal_comma=False)
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        if cell is None:
            continue
        try:
            values[row] = parse(cell)
        except (ValueError, OverflowError):
            shown = cell[:MAX_TEXT_CHARACTERS]
            raise UserError(
                f"{path}: row {first_row + row}: {column.name} = {shown!r}: must be a {column.kind.value}"
            ) from None
    return values


def to_floats(name: object, column: Column, values: ArrayLike) -> NDArray[np.float64]:
    """Convert a column of a table in memory to floats; None becomes NaN.

    Raises:
        UserError: A value is not a number.
    """
    array = np.asarray(values)
    if column.kind in (CellKind.DIRECTION, CellKind.LABEL):
        return parse_column(name, column, [str(value) for value in array.ravel().tolist()])
    if array.dtype.kind == "O" and all(value is None or isinstance(value, int | float) for value in array.flat):
        array = array.astype(np.float64)
    if array.dtype.kind not in "fiu" or array.ndim != 1:
        raise UserError(
            f"{name}: column {column.name} holds {array.dtype} of shape {array.shape}: must be numbers, one a row"
        )
    with np.errstate(invalid="ignore"):  # for signaling NaN
        return array.astype(np.float64)


NDA_MAGIC = b"NEWARE"
"""First bytes of Neware's .nda files."""
MPR_MAGIC = b"BIO-LOGIC MODULAR FILE"
"""First bytes of BioLogic's .mpr files."""
NDAX_MEMBER = ".ndc"
"""Ending of the names of members of Neware's .ndax files, which are zip archives."""


def read_neware(path: Path, finder: LayoutFinder, suffix: str) -> ArrayTable:
    """Read a file of a Neware cycler.

    Args:
        path: The file.
        finder: Finder of the columns of a sample.
        suffix: Kind of the file, ``.nda`` or ``.ndax``.

    Raises:
        UserError: The file is damaged or of an unknown version.
    """
    import fastnda  # noqa: PLC0415 - optional

    def read() -> ColumnTable:
        with _with_suffix(path, suffix) as renamed:
            return {column.name: column.to_numpy() for column in fastnda.read(renamed)}

    return ArrayTable(path, _call_library(path, read), finder, f"Neware {suffix}")


def read_biologic(path: Path, finder: LayoutFinder) -> ArrayTable:
    """Read a .mpr file of a BioLogic potentiostat.

    Raises:
        UserError: The file is damaged or has unknown columns.
    """
    from galvani import BioLogic  # noqa: PLC0415 - optional

    def read() -> ColumnTable:
        with path.open("rb") as file:
            data = BioLogic.MPRfile(file).data
        return {name: data[name] for name in data.dtype.names}

    return ArrayTable(path, _call_library(path, read), finder, "BioLogic .mpr")


def _call_library(path: Path, read: Callable[[], ColumnTable]) -> ColumnTable:
    """Return the table that a library reads. The library's warnings are suppressed, because they concern its internals.

    Raises:
        UserError: The library raised an error. All classes are caught, because neither library documents its errors.
    """
    logging.getLogger("fastnda").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    except Exception as error:  # noqa: BLE001
        reason = str(error) or type(error).__name__
        raise UserError(f"{path}: damaged, or of a version that cannot be read: {reason}; export it as text") from None


@contextmanager
def _with_suffix(path: Path, suffix: str) -> Iterator[Path]:
    """Yield a path of the file with a suffix, because fastnda recognizes the format by it."""
    if path.suffix.lower() == suffix:
        yield path
        return
    with TemporaryDirectory() as folder:
        link = Path(folder) / f"capture{suffix}"
        link.symlink_to(path.resolve())
        yield link
