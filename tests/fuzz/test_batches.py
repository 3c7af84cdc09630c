"""Edited batches of telemetry are rejected with a reason, or become blocks that can be decoded."""

from bms_estimator.edge.block import decode
from bms_estimator.fleet.ingest.batch_columns import BatchError
from bms_estimator.fleet.ingest.batch_samples import BatchReader
from bms_estimator.fleet.ingest.ingest import decode_batch
from bms_estimator.fleet.ingest.open_blocks import NO_POSITION, OpenBlocks
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
    blocks = OpenBlocks(60.0)
    blocks.set_position("p", NO_POSITION)
    selection = blocks.add("p", batch, ARRIVAL_S, 0.0, 1)
    blocks.complete()
    assert sum(decode(block.data).samples.size for block in blocks.completed) == selection.samples.size
