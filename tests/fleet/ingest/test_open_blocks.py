"""Open blocks of several packs, of which one has samples that cannot be encoded."""

import struct

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.fleet.ingest.batch_samples import BatchSamples
from bms_estimator.fleet.ingest.open_blocks import NO_POSITION, OpenBlocks
from bms_estimator.model.arrays import NO_CELLS, SampleBlock
from tests.fleet.ingest.platform import samples_of

ROWS = samples_of("p1", 30)
NOW_S = float(ROWS["time_s"][-1])


def batch(rows: SampleBlock, cells: int = 0) -> BatchSamples:
    """Return a batch with this number of cells. A block of 300 cells cannot be encoded."""
    return BatchSamples(rows, np.full((rows.size, cells), 3.7) if cells else NO_CELLS)


def blocks_of(*packs: str) -> OpenBlocks:
    """Return packs without samples."""
    blocks = OpenBlocks(60.0)
    for pack in packs:
        blocks.set_position(pack, NO_POSITION)
    return blocks


def test_batch_that_cannot_be_encoded_changes_nothing() -> None:
    blocks, expected = blocks_of("p1"), blocks_of("p1")
    for sequence, part in enumerate(np.split(ROWS, 3)):
        with pytest.raises(struct.error):
            blocks.add("p1", batch(ROWS[10 * sequence :], 300), NOW_S, 0.0, sequence)
        for each in (blocks, expected):
            each.add("p1", batch(part), NOW_S, 0.0, sequence)
    for each in (blocks, expected):
        each.complete()
    assert blocks.completed == expected.completed
    assert blocks.changed == expected.changed


def test_open_block_that_cannot_be_encoded_is_dropped_and_named() -> None:
    blocks = blocks_of("p1", "p2")
    for pack, cells in {"p1": 300, "p2": 16}.items():
        blocks.add(pack, batch(ROWS[:5], cells), NOW_S, 0.0, 1)
    with capture_logs() as lines:
        blocks.complete()
    assert [line["pack"] for line in lines] == ["p1"]
    assert [block.pack for block in blocks.completed] == ["p2"]
    assert blocks.first_sequence(7) == 7
