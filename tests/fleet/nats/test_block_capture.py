"""Capture of the blocks of a pack: each block once, in order."""

import numpy as np
import pytest

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.nats.block_capture import BlockCapture
from bms_estimator.model.arrays import NO_CELLS, SAMPLE

STORE_ID_NS = 1_700_000_000 * 10**9
"""Creation time of the edge's block store, which identifies it [ns since 1970]."""


def samples(first_s, count=60):
    """Return samples at 1 Hz from ``first_s`` on, relative to the creation of the store."""
    block = np.zeros(count, dtype=SAMPLE)
    block["time_s"] = first_s + np.arange(count)
    block["current_a"] = np.sin(block["time_s"] / 100.0)
    block["voltage_v"] = 3.7 - 0.01 * block["current_a"]
    for name in ("temperature_c", "temperature_min_c", "temperature_max_c"):
        block[name] = 25.0
    return block


def encoded_block(number, store=STORE_ID_NS, cells=0):
    """Return a block of 60 samples, which begins ``number`` minutes after the creation of the store."""
    rows = samples(60.0 * number)
    arrival_s = store * 1e-9 + rows["time_s"][-1]
    cells_v = 3.7 + 0.001 * np.tile(np.arange(float(cells)), (60, 1)) if cells else NO_CELLS
    return encode(Block(store, number, 1, arrival_s, rows, cells_v))


def make_capture(*blocks, **span):
    """Return a capture that has received the blocks, limited to a time span."""
    capture = BlockCapture(**span)
    for data in blocks:
        capture.add(data)
    return capture


def rows(capture):
    """Return all samples of a capture."""
    return np.concatenate([*capture.samples(), np.zeros(0, dtype=SAMPLE)])


def test_resent_and_late_blocks_appear_once_in_order():
    capture = make_capture(*map(encoded_block, (1, 2, 5, 3, 4, 5, 4)))
    assert (rows(capture) == samples(60.0, 300)).all()
    assert (capture.blocks, capture.repeated, capture.damaged, capture.missing) == (5, 2, 0, [])


def test_missing_and_damaged_blocks_are_counted():
    capture = make_capture(b"", encoded_block(1)[:-1], encoded_block(1), encoded_block(4), encoded_block(9))
    assert (capture.damaged, capture.missing) == (2, [(2, 3), (5, 8)])


def test_time_span_begins_and_ends_within_blocks():
    capture = make_capture(
        *map(encoded_block, range(1, 10)), since_s=STORE_ID_NS * 1e-9 + 130.0, until_s=STORE_ID_NS * 1e-9 + 200.0
    )
    assert rows(capture)["time_s"].tolist() == list(range(130, 200))
    assert capture.blocks == 2


@pytest.mark.parametrize(("created_after_s", "expected_first_s"), [(1000.0, 1060.0), (10.0, 179.0)])
def test_time_of_a_new_store_follows_from_its_creation_and_never_steps_back(created_after_s, expected_first_s):
    new_store = STORE_ID_NS + round(created_after_s * 1e9)
    capture = make_capture(encoded_block(1), encoded_block(2), encoded_block(1, new_store), encoded_block(3))
    time_s = rows(capture)["time_s"]
    assert (time_s.size, time_s[119], time_s[120]) == (180, 179.0, expected_first_s)
    assert capture.repeated == 1  # block 3 of the former store
    assert (np.diff(time_s) >= 0.0).all()


def test_cell_voltages_stand_beside_their_samples_and_other_blocks_have_none():
    blocks = (encoded_block(1), encoded_block(2, cells=3), encoded_block(3, cells=4), encoded_block(4, cells=4))
    capture = make_capture(*blocks, since_s=STORE_ID_NS * 1e-9 + 90.0, until_s=STORE_ID_NS * 1e-9 + 270.0)
    ((rows, cells_v),) = capture.samples_with_cells()
    assert (capture.cells, cells_v.shape) == (4, (180, 4))
    assert np.isnan(
        cells_v[rows["time_s"] < 180.0]
    ).all()  # blocks without cell voltages, or of another number of cells
    np.testing.assert_allclose(cells_v[rows["time_s"] >= 180.0], np.tile([3.7, 3.701, 3.702, 3.703], (90, 1)))


def test_capture_without_blocks_has_no_samples_and_no_span():
    assert rows(make_capture()).size == 0
    assert np.isnan(make_capture().span_s).all()
