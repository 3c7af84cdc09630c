"""What a pack has sent, put together: in order, each block once."""

import numpy as np
import pytest

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.identification.block_capture import BlockCapture
from bms_estimator.model.sample import SAMPLE

STORE = 1_700_000_000 * 10**9


def samples(first_s, count=60):
    block = np.zeros(count, dtype=SAMPLE)
    block["time_s"] = first_s + np.arange(count)
    block["current_a"] = np.sin(block["time_s"] / 100.0)
    block["voltage_v"] = 3.7 - 0.01 * block["current_a"]
    block["temperature_c"] = 25.0
    return block


def block(number, store=STORE, first_s=None):
    rows = samples(60.0 * number if first_s is None else first_s)
    return encode(Block(store, number, 1, store * 1e-9 + rows["time_s"][-1], rows))


def captured(*blocks, **span):
    found = BlockCapture(**span)
    for data in blocks:
        found.add(data)
    return found


def rows(found):
    return np.concatenate([*found.samples(), np.zeros(0, dtype=SAMPLE)])


def test_resends_and_gaps_leave_each_block_once_in_its_order():
    found = captured(block(1), block(2), block(5), block(3), block(4), block(5), block(4))
    assert (rows(found) == samples(60.0, 300)).all()
    assert (found.blocks, found.again, found.damaged, found.missing) == (5, 2, 0, [])


def test_what_is_missing_and_damaged_is_told():
    found = captured(b"", block(1)[:-1], block(1), block(4), block(9))
    assert (found.damaged, found.missing) == (2, [(2, 3), (5, 8)])


def test_a_span_is_cut_by_the_sample():
    found = captured(*map(block, range(1, 10)), since_s=STORE * 1e-9 + 130.0, until_s=STORE * 1e-9 + 200.0)
    assert rows(found)["time_s"].tolist() == list(range(130, 200))
    assert found.blocks == 2


@pytest.mark.parametrize(("later_s", "first_s"), [(1000.0, 1060.0), (10.0, 179.0)])
def test_time_goes_on_by_the_wall_clock_into_another_store_and_never_back(later_s, first_s):
    other = STORE + round(later_s * 1e9)
    found = captured(block(1), block(2), block(1, other), block(3))
    time_s = rows(found)["time_s"]
    assert (time_s.size, time_s[119], time_s[120]) == (180, 179.0, first_s)
    assert found.again == 1, "a block of the store that is over"
    assert (np.diff(time_s) >= 0.0).all()


def test_nothing_is_nothing():
    assert rows(captured()).size == 0
    assert np.isnan(captured().span_s).all()
