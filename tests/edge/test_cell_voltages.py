"""Cell voltages in blocks: restored exactly, compact, and rejected by programs that do not know them."""

import numpy as np
import pytest

from bms_estimator.edge.batching import MAX_SAMPLES, Batcher
from bms_estimator.edge.block import Block, BlockError, decode, encode
from bms_estimator.edge.cell_voltages import MAX_BYTES
from bms_estimator.fleet.nats.streams import MAX_BLOCK_BYTES
from bms_estimator.model.arrays import NO_CELLS, SAMPLE

STORE_ID_NS = 10**18


def samples(count):
    rows = np.zeros(count, SAMPLE)
    rows["time_s"] = np.arange(count)
    rows["voltage_v"], rows["current_a"] = 52.8, 5.0
    for name in ("temperature_c", "temperature_min_c", "temperature_max_c"):
        rows[name] = 25.0
    return rows


def block(rows, cells_v=NO_CELLS):
    return Block(STORE_ID_NS, 1, 1, 1e9, rows, cells_v)


def reported_cells(count, cells, seed=1):
    """Return voltages in whole millivolts, as battery management systems report them."""
    rng = np.random.default_rng(seed)
    volts = 3.3 + 0.01 * rng.standard_normal(cells) + 0.0007 * rng.standard_normal((count, cells))
    return np.round(volts, 3)


def test_voltages_in_millivolts_are_restored_exactly():
    cells_v = reported_cells(60, 16)
    decoded = decode(encode(block(samples(60), cells_v)))
    np.testing.assert_array_equal(decoded.cells_v, cells_v)
    assert decoded.samples.tobytes() == samples(60).tobytes()


def test_missing_voltages_and_a_dead_cell_are_restored():
    cells_v = reported_cells(60, 4)
    cells_v[5] = np.nan
    cells_v[7, 2] = np.nan
    cells_v[:, 3] = 0.0
    np.testing.assert_array_equal(decode(encode(block(samples(60), cells_v))).cells_v, cells_v)


def test_block_without_cell_voltages_has_the_bytes_of_version_1():
    data = encode(block(samples(60)))
    assert data[4:6] == b"\x01\x00"
    assert decode(data).cells_v.size == 0


def test_block_with_cell_voltages_has_another_version_so_that_earlier_workers_reject_it():
    assert encode(block(samples(60), reported_cells(60, 16)))[4:6] == b"\x02\x10"


def test_sixteen_cells_of_a_minute_take_less_than_a_byte_for_each_voltage():
    rows = samples(60)
    size = len(encode(block(rows, reported_cells(60, 16)))) - len(encode(block(rows)))
    assert size < 60 * 16


def test_largest_block_with_incompressible_samples_and_cells_is_below_the_servers_limit():
    rng = np.random.default_rng(2)
    rows = np.frombuffer(rng.bytes(MAX_SAMPLES * SAMPLE.itemsize), SAMPLE).copy()
    cells_v = rng.uniform(0.0, 5.0, (MAX_SAMPLES, 255))
    data = encode(block(rows, cells_v))
    assert len(data) < MAX_BLOCK_BYTES
    sent = ~np.isnan(decode(data).cells_v).all(axis=1)
    assert sent[0]
    assert 1 < sent.sum() <= MAX_BYTES / (4 + 2 * 255)


def test_any_damage_of_the_cell_voltages_is_an_error_or_harmless():
    data = encode(block(samples(5), reported_cells(5, 3)))
    for position in range(4, len(data)):
        damaged = data[:position] + bytes([data[position] ^ 0xFF]) + data[position + 1 :]
        try:
            decode(damaged)
        except BlockError:
            continue
    with pytest.raises(BlockError, match="do not hold the voltages of 4 cells"):
        decode(data[:5] + b"\x04" + data[6:])


def test_batcher_keeps_cell_voltages_beside_their_samples():
    batcher, cells_v = Batcher(block_s=60.0), reported_cells(150, 4)
    blocks = batcher.add(samples(150), 0.0, cells_v) + batcher.cut()
    assert [len(each.cells_v) for each in blocks] == [60, 60, 30]
    np.testing.assert_array_equal(np.concatenate([each.cells_v for each in blocks]), cells_v)


def test_samples_without_voltages_in_a_block_with_voltages_have_none():
    batcher = Batcher(block_s=60.0)
    batcher.add(samples(10), 0.0)
    later = samples(5)
    later["time_s"] += 10.0
    batcher.add(later, 0.0, reported_cells(5, 4))
    (ready,) = batcher.cut()
    assert np.isnan(ready.cells_v[:10]).all()
    np.testing.assert_array_equal(ready.cells_v[10:], reported_cells(5, 4))
