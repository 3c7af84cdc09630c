"""CSV and Parquet files with the estimates of each sample. They are written in blocks, so that memory does not grow.

The columns are the trace's fields and those of the forecast. Every value can be restored exactly.
"""

import gzip
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.errors import UserError

GZIP_LEVEL = 3
"""Compression level of gzip. It takes a third of the time of level 9, and the files are a few percent larger."""


class TableSink(Protocol):
    """File to which blocks of a trace are appended; leaving the context completes it.

    The first block replaces an existing file. A failure before the first block leaves the existing file unchanged.
    """

    def __enter__(self) -> Self:
        """Return the sink; the first block opens the file."""

    def __exit__(self, *_: object) -> None:
        """Complete the file."""

    def write(self, trace: NDArray[np.void]) -> None:
        """Append the rows of ``trace``, a structured array with the dtype of all earlier calls.

        Raises:
            UserError: The file cannot be written.
        """


class CsvSink:
    """CSV file, gzipped if its name ends in .gz.

    Args:
        path: The file.
        nan: Text of a value that is not known; an empty text leaves the cell empty.
    """

    def __init__(self, path: Path, nan: str = "nan") -> None:
        self._path, self._nan = path, nan
        self._files = ExitStack()
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def write(self, trace: NDArray[np.void]) -> None:
        """Append rows."""
        if self._file is None:
            self._file = self._open()
            self._file.write((",".join(trace.dtype.names or ()) + "\n").encode())
        if trace.size:
            self._file.write(_csv_rows(trace, self._nan))

    def _open(self) -> IO[bytes]:
        file = self._files.enter_context(_create(self._path))
        if self._path.suffix.lower() != ".gz":
            return file
        gzip_file = gzip.GzipFile(filename="", fileobj=file, mode="wb", compresslevel=GZIP_LEVEL)
        return self._files.enter_context(cast("IO[bytes]", gzip_file))


class ParquetSink:
    """Parquet file; needs pyarrow.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        import pyarrow  # noqa: F401, ICN001, PLC0415 - optional; a missing package must be reported before the replay

        self._path = path
        self._files = ExitStack()
        self._writer: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def write(self, trace: NDArray[np.void]) -> None:
        """Append rows."""
        from pyarrow import parquet  # noqa: PLC0415

        batch = _arrow_batch(trace)
        if self._writer is None:
            file = self._files.enter_context(_create(self._path))
            self._writer = self._files.enter_context(parquet.ParquetWriter(file, batch.schema))
        self._writer.write_batch(batch)


SINKS: dict[str, type[CsvSink | ParquetSink]] = {".csv": CsvSink, ".csv.gz": CsvSink, ".parquet": ParquetSink}
"""Sinks by file name extension."""


def table_sink(path: Path) -> TableSink:
    """Return the sink of ``path`` by its file name extension.

    Raises:
        UserError: The extension is unknown.
    """
    for suffix, sink in SINKS.items():
        if path.name.lower().endswith(suffix):
            return sink(path)
    raise UserError(f"{path}: the name must end in {', '.join(SINKS)}")


def join_columns(*blocks: NDArray[np.void]) -> NDArray[np.void]:
    """Return one structured array with the columns of all ``blocks``, which have equal lengths and different columns."""
    columns = {name: block[name] for block in blocks for name in block.dtype.names or ()}
    joined = np.empty(blocks[0].size, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        joined[name] = column
    return joined


def _create(path: Path) -> IO[bytes]:
    try:
        return path.open("wb")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def _csv_rows(trace: NDArray[np.void], nan: str) -> bytes:
    """Return rows as CSV, with enough digits to restore each float exactly."""
    columns = [map(repr, trace[name].tolist()) for name in trace.dtype.names or ()]
    return ("\n".join(map(",".join, zip(*columns, strict=True))) + "\n").replace("nan", nan).encode()


def _arrow_batch(trace: NDArray[np.void]) -> Any:
    import pyarrow as pa  # noqa: PLC0415

    names = list(trace.dtype.names or ())
    return pa.record_batch([pa.array(np.ascontiguousarray(trace[name])) for name in names], names=names)
