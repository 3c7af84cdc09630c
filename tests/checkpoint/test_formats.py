"""Numbers and record layouts of the files that the service leaves behind.

A file with another layout is refused. Who changes a layout raises the number of its format, lets the reader convert the format
before, and changes this table.
"""

import hashlib
from typing import Any

import numpy as np
import pytest

from bms_estimator.checkpoint import arrays_file, run_file, state_files
from bms_estimator.edge import block
from bms_estimator.fleet.worker.checkpoint import checkpoint_format
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.kernels.cells.records import BANK_STATE, CELL
from bms_estimator.model.payloads.health import PAYLOAD_VERSION


def test_formats_have_their_numbers() -> None:
    assert (state_files.FORMER_FORMAT, state_files.FORMAT) == (7, 8)
    assert (arrays_file.FORMAT, run_file.FORMAT) == (1, 1)
    assert (checkpoint_format.FORMAT, checkpoint_format.INCREMENT_FORMAT) == (3, 3)
    assert (block.VERSION, PAYLOAD_VERSION) == (3, 3)


@pytest.mark.parametrize(
    ("layout", "digest"),
    [(HISTORY_ROW, "253baf35d5eea4fd"), (CELL, "f67d32a2a2c02beb"), (BANK_STATE, "2aa7702d379485e9")],
    ids=["history, format 1", "cells, format 8", "bank, format 8"],
)
def test_records_have_the_layout_of_their_format(layout: np.dtype[Any], digest: str) -> None:
    assert hashlib.sha256(repr(np.lib.format.dtype_to_descr(layout)).encode()).hexdigest()[:16] == digest
