"""Division of samples into blocks: each sample is in one block, in order."""

import numpy as np
from hypothesis import given, strategies as st

from bms_estimator.edge.batching import Batcher
from bms_estimator.model.arrays import SAMPLE, SampleBlock


def samples_at(times_s: np.ndarray) -> SampleBlock:
    rows = np.zeros(times_s.size, dtype=SAMPLE)
    rows["time_s"] = times_s
    return rows


def test_block_of_a_minute_at_1_hz_has_60_samples_and_the_arrival_time_of_its_last() -> None:
    batcher = Batcher(block_s=60.0)
    blocks = [block for t in range(181) for block in batcher.add(samples_at(np.array([float(t)])), t + 0.5)]
    assert [block.samples.size for block in blocks] == [60, 60, 60]
    assert [block.arrival_s for block in blocks] == [59.5, 119.5, 179.5]
    assert [block.samples.size for block in batcher.cut()] == [1]
    assert batcher.cut() == []


@given(st.lists(st.lists(st.floats(0.0, 30.0), max_size=40), max_size=20), st.integers(1, 7))
def test_blocks_contain_all_samples_in_order(reads: list[list[float]], max_samples: int) -> None:
    """Each read is a list of the intervals between its samples [s]."""
    batcher, time_s, all_times_s, blocks = Batcher(20.0, max_samples), 0.0, [], []
    for intervals_s in reads:
        times_s = time_s + np.cumsum(intervals_s)
        time_s = times_s[-1] if times_s.size else time_s
        all_times_s.append(times_s)
        blocks += batcher.add(samples_at(times_s), time_s)
    blocks += batcher.cut()
    assert all(1 <= block.samples.size <= max_samples for block in blocks)
    assert all(np.ptp(block.samples["time_s"]) < 20.0 for block in blocks)
    block_times_s = [block.samples["time_s"] for block in blocks]
    assert np.concatenate([*block_times_s, []]).tolist() == np.concatenate([*all_times_s, []]).tolist()
