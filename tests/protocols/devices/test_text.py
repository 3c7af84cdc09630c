"""Decoder of printed lines: chunk boundaries do not change the result, and invalid lines are reported."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bms_estimator.model.arrays import NO_CELLS, SampleBlock, SampleStatus
from bms_estimator.protocols.devices.text import MAX_LINE_BYTES, TextProtocol

lines = (
    st.binary(max_size=40)
    | st.integers(0, 2 * MAX_LINE_BYTES).map(lambda n: n * b" " + b"3.3,0.1")
    | st.tuples(st.floats(0, 60), st.floats(-9, 9)).map(lambda vi: b"%.3f,%.3f" % vi)
    | st.just(b"V=3.3 I=2 cells=3.31,3.29")
    | st.just(b'{"voltage": 3.4, "current": 1}')
)
streams = st.lists(lines, max_size=12).map(b"\n".join)
cut_positions = st.lists(st.integers(0, 8 * MAX_LINE_BYTES), max_size=12)


def decode(data: bytes, cuts: list[int]) -> tuple[TextProtocol, SampleBlock, list[list[float]]]:
    """Decode ``data``, cut into chunks at ``cuts``. Return the decoder, the samples and their cell voltages."""
    decoder = TextProtocol()
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    blocks, cells = [], []
    for a, b in itertools.pairwise(edges):
        blocks.append(decoder.feed(1.0, data[a:b]))
        cells += [[v for v in row if not math.isnan(v)] for row in decoder.cells.tolist()] or [[]] * blocks[-1].size
    return decoder, np.concatenate(blocks), cells


@settings(max_examples=300)
@given(streams, cut_positions)
def test_no_bytes_raise_and_chunk_boundaries_do_not_change_the_result(data: bytes, cuts: list[int]) -> None:
    decoder, whole_block, cells = decode(data, [])
    cut_decoder, cut_block, cut_cells = decode(data, cuts)
    for name in ("voltage_v", "current_a", "temperature_c"):
        assert whole_block[name].tobytes() == cut_block[name].tobytes()
    assert cells == cut_cells
    assert (decoder.counters, decoder.fault) == (cut_decoder.counters, cut_decoder.fault)
    assert decoder.counters["frames_received"] == whole_block.size


def test_end_of_a_line_that_exceeds_the_maximum_length_is_not_decoded_as_a_line() -> None:
    data = b"\n" + MAX_LINE_BYTES * b"x" + b"3.3,0.1\n3.4,0.2\n"
    _, block, _ = decode(data, [MAX_LINE_BYTES + 1])
    assert block["voltage_v"].tolist() == [3.4]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"V=13.3kV I=2\r\n", "the first: 'V=13.3kV I=2'"),
        (b"\x1b[31mhot\n", "the first: '\\x1b[31mhot'"),
        (b"INA226 ready\nwaiting\n", "the first: 'INA226 ready'"),
        (200 * b"x" + b"\n", f"the first: '{60 * 'x'}'..."),
    ],
)
def test_first_invalid_line_is_reported_in_full_or_with_60_characters_until_a_valid_line(
    data: bytes, message: str
) -> None:
    incomplete_first_line = b"half\n"  # which is never reported
    decoder, _, _ = decode(incomplete_first_line + data, [])
    assert decoder.fault is not None
    assert message in decoder.fault
    assert "baud" not in decoder.fault
    decoder.feed(2.0, b"3.3,0.1\n")
    assert decoder.fault is None


def test_bytes_that_are_no_text_are_reported_as_a_wrong_baud_rate() -> None:
    decoder, _, _ = decode(bytes(range(128, 256)) * (MAX_LINE_BYTES // 100), [])
    assert "wrong baud rate" in (decoder.fault or "")


def test_cell_voltages_belong_to_the_sample_of_their_line() -> None:
    decoder = TextProtocol()
    block = decoder.feed(1.0, b"V=6.6 I=2 cells=3.31,3.29\n6.6,2\nV=6.6 I=2 cells=3.3\n")
    assert block.size == 3
    assert decoder.cells.dtype == np.float64
    np.testing.assert_equal(decoder.cells, [[3.31, 3.29], [np.nan, np.nan], [3.3, np.nan]])
    assert decoder.feed(2.0, b"6.6,2\n").size == 1
    assert decoder.cells is NO_CELLS


def test_reads_decoded_as_a_batch_give_the_same_samples_as_one_by_one() -> None:
    reads = [b"6.6,2,25\nV=6.6 I=2 T=25 ce", b"lls=3.31,3.29\n", b"6.7,2,25\n"]
    single_reads_decoder, batch_decoder = TextProtocol(), TextProtocol()
    blocks = [single_reads_decoder.feed(float(i), read) for i, read in enumerate(reads)]
    data = np.frombuffer(b"".join(reads), dtype=np.uint8)
    ends = np.cumsum([len(read) for read in reads])
    batch_block = batch_decoder.feed_reads(np.arange(3.0), ends, data)
    np.testing.assert_array_equal(batch_block, np.concatenate(blocks))
    np.testing.assert_equal(batch_decoder.cells, [[np.nan, np.nan], [3.31, 3.29], [np.nan, np.nan]])


def test_the_mark_of_a_held_voltage_is_a_status_bit() -> None:
    _, block, _ = decode(b'\nV=3.3 I=1\n{"voltage": 3.3, "current": 2, "voltage_held": true}\n3.4,2.0\n', [])
    assert block["status"].tolist() == [0, SampleStatus.VOLTAGE_HELD, 0]
