"""Samples of batches in JSON and Arrow, and the errors of invalid batches."""

import json
import math
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import example, given, strategies as st

from bms_estimator.fleet.ingest.batch_samples import (
    BatchError,
    BatchReader,
    BatchSamples,
    drop_reason,
    select_new,
    split_by_time,
)
from bms_estimator.fleet.ingest.ingest import decode_batch
from bms_estimator.model.arrays import NO_CELLS, SAMPLE
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map
from tests.fleet.ingest.platform import arrow_batch, arrow_bytes, arrow_with_shared_columns, json_batch, samples_of

ROWS = samples_of("p1", 5)
TIMES = ROWS["time_s"].tolist()
ISO_TIMES = [datetime.fromtimestamp(time_s, UTC).isoformat() for time_s in TIMES]
VALUES = {"current_a": [1.0, 2.0, 3.0, 4.0, 5.0], "voltage_v": [3.7] * 5}
NOW_S = TIMES[-1] + 1.0
MANY_COLUMNS = ["time_s", "current_a", "voltage_v", *(f"cell_{number}_v" for number in range(1, 256))]


def read(payload: bytes, **options: Any) -> BatchSamples:
    return BatchReader(**options).read(decode_batch(payload))


def encode(document: object) -> bytes:
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    "payload",
    [
        json_batch(ROWS),
        arrow_batch(ROWS),
        encode([dict(zip(SAMPLE.names[:4], row.tolist()[:4], strict=True)) for row in ROWS]),
    ],
    ids=["columns", "arrow", "rows"],
)
def test_samples_of_each_form_are_equal(payload: bytes) -> None:
    assert read(payload).samples.tolist() == ROWS.tolist()


def test_columns_that_are_not_used_may_have_any_type() -> None:
    table = pa.table({"time_s": TIMES, **VALUES, "charging": [True] * 5, "place": [{"lat": 1.0}] * 5})
    assert read(arrow_bytes(table)).samples.size == 5
    assert read(encode({"time_s": TIMES, **VALUES, "charging": [True] * 5, "place": ["x"] * 5})).samples.size == 5
    assert read(encode({"time_s": TIMES, **VALUES, "pack": "p1"})).samples.size == 5


def test_single_row_needs_no_lists() -> None:
    row = {"time": None, "current_a": 1, "voltage_v": 3.7}
    assert read(encode([row, row | {"time": ISO_TIMES[0]}])).samples["time_s"][1] == TIMES[0]
    assert read(encode(row | {"time": ISO_TIMES[0], "cells_v": [3.6, 3.7]})).cells_v.tolist() == [[3.6, 3.7]]
    assert read(encode({"time_s": TIMES[0], "current_a": 1, "voltage_v": None})).samples.size == 1


@pytest.mark.parametrize(
    "times",
    [
        encode({"time": ISO_TIMES} | VALUES),
        encode({"time": [text.replace("+00:00", "Z") for text in ISO_TIMES]} | VALUES),
        encode({"time_ms": [round(1000 * time_s) for time_s in TIMES]} | VALUES),
        arrow_bytes(
            pa.table({"timestamp": pa.array([round(1e9 * t) for t in TIMES], pa.timestamp("ns", "UTC"))} | VALUES)
        ),
        arrow_bytes(pa.table({"timestamp": pa.array([round(1e3 * t) for t in TIMES], pa.timestamp("ms"))} | VALUES)),
    ],
    ids=["ISO 8601", "ISO 8601 with Z", "milliseconds", "Arrow in ns", "Arrow in ms without time zone"],
)
def test_timestamps_become_seconds_since_1970(times: bytes) -> None:
    assert read(times).samples["time_s"].tolist() == TIMES


def test_columns_units_and_sign_are_as_for_captures() -> None:
    batch = encode({"t": TIMES, "U_pack": [3700.0] * 5, "I(mA)": [1500.0] * 5, "T": [21.0, None, 999.0, 21.0, 21.0]})
    column_map = parse_column_map("time=t,current=I(mA),voltage=U_pack,temperature=T")
    samples = read(batch, column_map=column_map, current_sign="charge_positive").samples
    assert samples["current_a"].tolist() == [-1.5] * 5
    assert samples["voltage_v"].tolist() == [3700.0] * 5  # the name states no unit
    assert np.isnan(samples["temperature_c"]).tolist() == [False, True, True, False, False]


def test_cell_voltages() -> None:
    cells = [[3600, 3700], [3601, 3701], None, [3603, None], [3604, 99_999]]
    table = pa.table({"time_s": TIMES, **VALUES, "cells_mv": pa.array(cells, pa.list_(pa.float64()))})
    for payload in (encode({"time_s": TIMES, "cells_mv": cells} | VALUES), arrow_bytes(table)):
        cells_v = read(payload).cells_v
        np.testing.assert_array_equal(np.isnan(cells_v).sum(axis=1), [0, 0, 2, 1, 1])
        np.testing.assert_allclose(cells_v[1], [3.601, 3.701], rtol=1e-12)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "neither JSON nor Arrow IPC"),
        (b"\x00\xff garbage", "neither JSON nor Arrow IPC"),
        (b"[" * 100_000, "neither JSON nor Arrow IPC"),
        (encode(5), "must be an object of columns or a list of rows"),
        (encode([]), "has no rows"),
        (encode([{"time_s": 1.0}, 5]), "row 2 is no object"),
        (encode({"time_s": TIMES, "voltage_v": [3.7] * 5}), "no column of current; found time_s, voltage_v"),
        (encode({"time_s": TIMES, "current_a": [1.0], "voltage_v": [3.7] * 5}), "the columns differ in length"),
        (encode(VALUES | {"time_s": [1, 2, 3, "soon", 5]}), "row 4: time_s = 'soon': must be a number"),
        (encode(VALUES | {"time": ["soon"] * 5}), "row 1: time = 'soon': must be a date and time"),
        (encode(VALUES | {"time": [*ISO_TIMES[:4], 5]}), "row 5: time = 5: must be a date and time"),
        (encode(VALUES | {"time_s": TIMES, "voltage_v": [3.7, True, 3.7, 3.7, 3.7]}), "row 2: voltage_v = True"),
        (encode(VALUES | {"time_s": TIMES, "voltage_v": [[3.7]] * 5}), "row 1: voltage_v = [3.7]: must be a number"),
        (encode(VALUES | {"time_s": [10**400] * 5}), "a number is too large"),
        (encode(VALUES | {"time_s": TIMES, "cells_v": [[3.7]] * 4 + [[3.7, 3.7]]}), "cells_v: must be one list"),
        (encode(VALUES | {"time_s": TIMES, "cells_v": [["full"]] * 5}), "cells_v: must be numbers"),
        (encode(VALUES | {"time_s": TIMES, "cells_v": [[[3.7]]] * 5}), "cells_v: must be numbers"),
        (encode(VALUES | {"time_s": TIMES, "cells_v": [[10**400]] * 5}), "a number is too large"),
        (encode(VALUES | {"time_s": TIMES} | {f"cell_{n}_v": [3.7] * 5 for n in range(1, 257)}), "256 columns of cell"),
        (encode({name: [1.0] * 5000 for name in MANY_COLUMNS[:3]} | {"cells_v": [[3.7] * 255] + [None] * 4999}), "values"),
        (encode(dict.fromkeys(map(str, range(4097)), 1)), "4,097 columns: must be at most 4,096"),
        (encode([dict.fromkeys(map(str, range(1000)))] + [{}] * 2000), "2,001,000 values: must be at most 1,048,576"),
        (encode(VALUES)[:-1] + b', "voltage_v": []}', "several columns have the same name"),
        (arrow_bytes(pa.concat_tables(2 * [pa.table({"time_s": pa.nulls(2**19)})])), "2,097,152 values: must be at most"),
        (arrow_with_shared_columns(MANY_COLUMNS, 5000), "values: must be at most 1,048,576"),
        (arrow_batch(ROWS)[:-60], "damaged Arrow IPC"),
        (b"ARROW1\0\0" + b"\xff" * 100, "damaged Arrow IPC"),
        (arrow_bytes(pa.table(VALUES | {"time_s": [True] * 5})), "column time_s is bool: must be numbers"),
        (arrow_bytes(pa.table({"a": pa.array(["x"]).dictionary_encode()})), "dictionary is not supported"),
        (arrow_bytes(pa.table({"time_s": []}, pa.schema([("time_s", "f8")]))), "has no rows"),
        (arrow_bytes(pa.table({"time_s": np.zeros(10**6)}), compression="zstd"), "compressed: send it uncompressed"),
        (arrow_bytes(pa.table({"time_s": pa.nulls(2**20, pa.float64())})), "values: must be at most 1,048,576"),
    ],
)  # fmt: skip
def test_error_names_what_is_wrong(payload: bytes, reason: str) -> None:
    with pytest.raises(BatchError) as caught:
        read(payload)
    assert reason in str(caught.value)


@given(st.binary(max_size=64), st.integers(0, 800))
@example(b"\x80", 100)  # a name that is not UTF-8
def test_damaged_arrow_is_rejected_or_read(damage: bytes, offset: int) -> None:
    data = arrow_batch(ROWS)
    offset = min(offset, len(data) - len(damage))
    with suppress(BatchError):
        assert read(data[:offset] + damage + data[offset + len(damage) :]).samples.dtype == SAMPLE


def test_each_cell_may_have_a_column_of_its_own():
    columns = {"cell_1_v": [3.6] * 5, "cell_2_v": [3.7, None, 99.0, 3.7, 3.7]}
    cells_v = read(encode({"time_s": TIMES} | columns | VALUES)).cells_v
    np.testing.assert_array_equal(cells_v[:, 0], 3.6)
    np.testing.assert_array_equal(cells_v[:, 1], [3.7, np.nan, np.nan, 3.7, 3.7])


def test_layouts_of_large_headers_are_not_cached() -> None:
    reader = BatchReader()
    for columns in (500, 10):
        reader.read(decode_batch(encode({"time_s": TIMES, **VALUES} | {f"other {n}": [0] * 5 for n in range(columns)})))
    assert reader._find_cached.cache_info().currsize == 1


def test_parts_of_a_batch_are_in_order_of_time() -> None:
    parts = split_by_time(batch(5.0, 1.0, 4.0, 2.0, 3.0), 2)
    assert [part.samples["time_s"].tolist() for part in parts] == [[1.0, 2.0], [3.0, 4.0], [5.0]]


def batch(*times: float) -> BatchSamples:
    """Return samples with these times, whose current is their position."""
    rows = np.zeros(len(times), SAMPLE)
    rows["time_s"], rows["current_a"] = times, np.arange(len(times))
    return BatchSamples(rows, NO_CELLS)


def test_new_samples_are_sorted_and_unique() -> None:
    t0 = TIMES[0]
    selection = select_new(batch(t0 + 3, t0 + 1, t0 + 2, t0 + 1, t0, t0 - 5), t0, NOW_S)
    assert (selection.samples["time_s"] - t0).tolist() == [1.0, 2.0, 3.0]
    assert selection.samples["current_a"].tolist() == [1.0, 2.0, 0.0]
    assert (selection.old, selection.implausible) == (3, 0)
    assert drop_reason(3, 0, t0) == (
        "3 samples at or before the pack's last stored time 2023-11-14T22:13:20.000Z: sent again, or too late"
    )


def test_implausible_times_are_dropped_and_named() -> None:
    selection = select_new(batch(math.nan, 12.5, 1000.0 * TIMES[0], TIMES[0]), -math.inf, NOW_S)
    assert (selection.samples.size, selection.old, selection.implausible) == (1, 0, 3)
    assert "time_ms" in drop_reason(0, 3, -math.inf)
