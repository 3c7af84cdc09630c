"""Edited batches of telemetry are rejected with a reason, or become blocks that can be decoded."""

import contextlib
import math
import sqlite3

from bms_estimator.edge.batching import Batcher
from bms_estimator.edge.block import decode
from bms_estimator.edge.block_table import (
    INGEST_TABLES,
    BlockRange,
    PackPosition,
    Progress,
    read_pages,
    write_changes,
)
from bms_estimator.fleet.ingest.batch_samples import BatchError, BatchReader, select_new
from bms_estimator.fleet.ingest.ingest import decode_batch
from bms_estimator.store.migrations import migrate
from tests.fuzz.edited_seeds import edited_seeds

ARRIVAL_S = 1_800_000_000.0
"""Arrival of each batch [s since 1970], after the times of the seeds."""
READER = BatchReader()


@edited_seeds(
    "batch", b'"cells_v":[[', b'"cell_1_v":[', b'"time_ms":', b"null", b"]]", b"[[[", b'{"', b"\xff\xff\xff\xff"
)
def test_edited_batches_are_rejected_with_a_reason_or_become_blocks(data: bytes) -> None:
    try:
        batch = READER.read(decode_batch(data))
    except BatchError as error:
        assert str(error)  # noqa: PT017
        return
    selection, batcher = select_new(batch, -math.inf, ARRIVAL_S), Batcher(60.0)
    ready = batcher.add(selection.samples, ARRIVAL_S, selection.cells_v) + batcher.cut()
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        migrate(database, INGEST_TABLES)
        waiting = [("p", block) for block in ready]
        limits = {"max_blocks": len(ready), "max_bytes": math.inf}
        position = write_changes(database, {"p": PackPosition()}, waiting, (), Progress(), **limits)["p"]
        blocks_of_pack = BlockRange("p", position.created_s, 1, position.next_number)
        (page,) = read_pages(database, [blocks_of_pack], len(ready) + 1)
    assert sum(decode(data).samples.size for data in page.blocks.values()) == selection.samples.size
