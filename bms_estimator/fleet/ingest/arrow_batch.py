"""Columns of a batch in the streaming format of Arrow IPC.

Few bytes may expand to any size, because columns may be compressed, have a dictionary, or refer to the same bytes
(https://arrow.apache.org/docs/format/Columnar.html#serialization-and-interprocess-communication-ipc). Therefore compressed
columns and dictionaries are rejected, and the number of values is limited, before a record batch is decoded.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa

from bms_estimator.fleet.ingest.batch_samples import BatchColumns, BatchError, Values, check_count

_HEADER, _LENGTH, _NODES, _COMPRESSION = 2, 0, 1, 3
"""Indices of fields: ``header`` of the table ``Message``; ``length``, ``nodes``, ``compression`` of the table ``RecordBatch``."""
_NODE = struct.Struct("<qq")
"""Layout of a ``FieldNode``: number of values of a column, or of all its lists, and number of nulls."""


def decode_arrow(payload: bytes) -> BatchColumns:
    """Return the columns of a stream of one or more record batches.

    Raises:
        BatchError: The bytes are damaged, or the batch has too many values.
    """
    try:
        return _decode(payload)
    except BatchError:
        raise
    except (pa.ArrowException, ValueError, OSError, struct.error, MemoryError) as error:
        raise BatchError(f"damaged Arrow IPC: {error}") from None


class ArrowColumns(Mapping[str, Values]):
    """Columns of a table, each converted when it is used."""

    def __init__(self, table: "pa.Table | pa.RecordBatch") -> None:
        self._table = table

    def __getitem__(self, name: str) -> Values:
        return _values(name, self._table.column(name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._table.schema.names)

    def __len__(self) -> int:
        return len(self._table.schema.names)


def columns_of(table: "pa.Table | pa.RecordBatch") -> BatchColumns:
    """Return the columns of a table.

    Raises:
        BatchError: Several columns have the same name. The use of a column with an unsupported type raises this error too.
    """
    names = table.schema.names
    if len(set(names)) < len(names):
        raise BatchError(f"several columns have the same name: {', '.join(names)}")
    return ArrowColumns(table)


def _decode(payload: bytes) -> BatchColumns:
    reader = pa.ipc.MessageReader.open_stream(payload)
    schema, batches, values = None, [], 0
    for message in _messages(reader):
        if message.type == "schema":
            schema = pa.ipc.read_schema(message)
        elif message.type == "record batch" and schema is not None:
            values += _count_values(message.metadata.to_pybytes())
            check_count(values)
            batches.append(pa.ipc.read_record_batch(message, schema))
        else:
            raise BatchError(f"an Arrow message {message.type} is not supported: send columns without dictionaries")
    if schema is None or not any(batch.num_rows for batch in batches):
        raise BatchError("has no rows")
    table = pa.Table.from_batches(batches, schema)
    table.validate(full=True)
    return columns_of(table)


def _messages(reader: Any) -> Any:
    """Yield the messages of a stream."""
    while True:
        try:
            yield reader.read_next_message()
        except StopIteration:
            return


def _is_supported(column_type: "pa.DataType") -> bool:
    types = pa.types
    if types.is_list(column_type) or types.is_large_list(column_type) or types.is_fixed_size_list(column_type):
        return _is_number(column_type.value_type)
    return _is_number(column_type) or types.is_timestamp(column_type) or _is_text(column_type)


def _is_number(column_type: "pa.DataType") -> bool:
    return bool(pa.types.is_integer(column_type) or pa.types.is_floating(column_type))


def _is_text(column_type: "pa.DataType") -> bool:
    return bool(pa.types.is_string(column_type) or pa.types.is_large_string(column_type))


def _count_values(metadata: bytes) -> int:
    """Return the number of rows and values in the header of a record batch, before its body is decoded.

    Raises:
        BatchError: The record batch is compressed.
        struct.error: The header is damaged.
    """
    message = _reference(metadata, 0)
    header = _field(metadata, message, _HEADER)
    record_batch = _reference(metadata, header) if header else 0
    if not header or _field(metadata, record_batch, _COMPRESSION):
        raise BatchError("the Arrow record batch is compressed: send it uncompressed")
    length = _field(metadata, record_batch, _LENGTH)
    (rows,) = struct.unpack_from("<q", metadata, length) if length else (0,)
    counts = [rows, *(count for count, _ in _NODE.iter_unpack(_node_bytes(metadata, record_batch)))]
    if min(counts) < 0:
        raise BatchError("damaged Arrow IPC: a negative number of values")
    return sum(counts)


def _node_bytes(metadata: bytes, record_batch: int) -> bytes:
    """Return the vector ``nodes`` of a record batch."""
    field = _field(metadata, record_batch, _NODES)
    if not field:
        return b""
    vector = _reference(metadata, field)
    (count,) = struct.unpack_from("<I", metadata, vector)
    return metadata[vector + 4 : vector + 4 + _NODE.size * count]


def _reference(data: bytes, offset: int) -> int:
    """Return the offset of the flatbuffer table to which an offset refers."""
    (relative,) = struct.unpack_from("<I", data, offset)
    return offset + int(relative)


def _field(data: bytes, table: int, index: int) -> int:
    """Return the offset of a field of a flatbuffer table; 0 if the table does not have the field."""
    (distance,) = struct.unpack_from("<i", data, table)
    vtable = table - distance
    (size,) = struct.unpack_from("<H", data, vtable)
    entry = 4 + 2 * index  # after the sizes of the vtable and of the table
    if entry >= size:
        return 0
    (relative,) = struct.unpack_from("<H", data, vtable + entry)
    return table + int(relative) if relative else 0


def _values(name: str, column: Any) -> Values:
    """Return a column as an array of floats or of timestamps, or as a list of texts or of lists of numbers."""
    column_type = column.type
    if not _is_supported(column_type):
        raise BatchError(f"column {name} is {column_type}: must be numbers, timestamps, texts, or lists of numbers")
    if pa.types.is_timestamp(column_type):
        stamps: Values = column.cast(pa.timestamp("us"), safe=False).to_numpy(zero_copy_only=False)
        return stamps
    if _is_number(column_type):
        floats: Values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        return floats
    texts_or_lists: Values = column.to_pylist()
    return texts_or_lists
