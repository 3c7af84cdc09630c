"""Capture of a pack's blocks: in order, each block once."""

import numpy as np
import pytest

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.identification.block_capture import BlockCapture
from bms_estimator.model.sample import SAMPLE

STORE_ID_NS = 1_700_000_000 * 10**9
"""Creation time of the edge's block store, which identifies it [ns since 1970]."""


def samples(first_s, count=60):
    block = np.zeros(count, dtype=SAMPLE)
    block["time_s"] = first_s + np.arange(count)
    block["current_a"] = np.sin(block["time_s"] / 100.0)
    block["voltage_v"] = 3.7 - 0.01 * block["current_a"]
    block["temperature_c"] = 25.0
    return block


def encoded_block(number, store=STORE_ID_NS, first_s=None):
    rows = samples(60.0 * number if first_s is None else first_s)
    arrival_s = store * 1e-9 + rows["time_s"][-1]
    return encode(Block(store=store, number=number, oldest=1, arrival_s=arrival_s, samples=rows))


def make_capture(*blocks, **span):
    capture = BlockCapture(**span)
    for data in blocks:
        capture.add(data)
    return capture


def rows(capture):
    return np.concatenate([*capture.samples(), np.zeros(0, dtype=SAMPLE)])


def test_resent_and_late_blocks_appear_once_in_order():
    capture = make_capture(
        encoded_block(1),
        encoded_block(2),
        encoded_block(5),
        encoded_block(3),
        encoded_block(4),
        encoded_block(5),
        encoded_block(4),
    )
    assert (rows(capture) == samples(60.0, 300)).all()
    assert (capture.blocks, capture.repeated, capture.damaged, capture.missing) == (5, 2, 0, [])


def test_missing_and_damaged_blocks_are_counted():
    capture = make_capture(b"", encoded_block(1)[:-1], encoded_block(1), encoded_block(4), encoded_block(9))
    assert (capture.damaged, capture.missing) == (2, [(2, 3), (5, 8)])


def test_time_span_is_cut_at_samples():
    capture = make_capture(
        *map(encoded_block, range(1, 10)), since_s=STORE_ID_NS * 1e-9 + 130.0, until_s=STORE_ID_NS * 1e-9 + 200.0
    )
    assert rows(capture)["time_s"].tolist() == list(range(130, 200))
    assert capture.blocks == 2


@pytest.mark.parametrize(("later_s", "first_s"), [(1000.0, 1060.0), (10.0, 179.0)])
def test_time_continues_by_the_wall_clock_and_never_steps_back(later_s, first_s):
    new_store = STORE_ID_NS + round(later_s * 1e9)
    capture = make_capture(encoded_block(1), encoded_block(2), encoded_block(1, new_store), encoded_block(3))
    time_s = rows(capture)["time_s"]
    assert (time_s.size, time_s[119], time_s[120]) == (180, 179.0, first_s)
    assert capture.repeated == 1, "a block of the former store"
    assert (np.diff(time_s) >= 0.0).all()


def test_empty_capture():
    assert rows(make_capture()).size == 0
    assert np.isnan(make_capture().span_s).all()
