"""Transactions on the stored blocks."""

import contextlib
import sqlite3
from collections.abc import Iterator

import numpy as np
import pytest

from bms_estimator.edge.batching import ReadyBlock
from bms_estimator.edge.block import decode
from bms_estimator.fleet.ingest import store_table
from bms_estimator.fleet.ingest.open_blocks import NO_POSITION
from bms_estimator.fleet.ingest.store_table import (
    INGEST_TABLES,
    BlockPage,
    Changes,
    NumberedBlock,
    PackPosition,
    Progress,
    read_state,
)
from tests.fleet.ingest.platform import START_S, samples_of


@pytest.fixture
def database() -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript("".join(INGEST_TABLES))
        yield connection


def changes(pack: str, count: int, **more: object) -> Changes:
    """Return a transaction that inserts the first ``count`` blocks of a pack, with six samples each."""
    position, blocks = NO_POSITION, []
    for part in np.split(samples_of("p1", 6 * count), count):
        number, ready = position.next_number, ReadyBlock(START_S, part)
        position = position.after(ready)
        blocks.append(NumberedBlock.of(pack, number, position.created_s, ready))
    return Changes(Progress("now", 7, 0), blocks, {pack: position}, **more)


def test_repeated_transaction_has_no_effect(database: sqlite3.Connection) -> None:
    for _ in range(2):
        assert changes("p1", 3, confirmed_below={"p1": 2})(database) == 0
    state = read_state(database)
    assert state == (
        Progress("now", 7, 0),
        {"p1": PackPosition(int(START_S), 4, START_S + 170.0)},
        {"p1": 2},
    )


def test_blocks_have_the_number_of_the_oldest_stored_one(database: sqlite3.Connection) -> None:
    changes("p1", 4, confirmed_below={"p1": 3})(database)
    changes("p2", 1)(database)
    page = BlockPage(10)(database)
    blocks = [decode(stored.data) for stored in page]
    assert [(stored.pack, block.number, block.oldest) for stored, block in zip(page, blocks, strict=True)] == [
        ("p1", 3, 3),
        ("p1", 4, 3),
        ("p2", 1, 1),
    ]
    assert blocks[0].samples["time_s"].tolist() == [120.0, 130.0, 140.0, 150.0, 160.0, 170.0]
    assert BlockPage(10, pack="p1", first=4)(database) == page[1:2]
    assert BlockPage(10, after_id=page[1].id)(database) == page[2:]


def test_oldest_blocks_of_a_pack_are_dropped_and_those_of_others_stay(
    database: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_table, "MAX_PACK_BLOCKS", 2)
    changes("p1", 2)(database)
    assert changes("p2", 5)(database) == 3
    assert read_state(database).oldest == {"p1": 1, "p2": 4}
    Changes(Progress("now", 8, 0), removed=["p2"])(database)
    assert read_state(database).positions.keys() == {"p1"}
