"""Values of the single cells in the hourly row."""

import numpy as np
import pytest

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.sample import NO_CELLS, SAMPLE
from tests.fleet.partition_stream import STORE_ID_NS, table

DEVIATIONS_V = np.array([0.010, -0.030, 0.005, 0.015])
"""Deviations of the cells from their mean [V]."""


def minute(number, current_a, cells_v):
    rows = np.zeros(60, SAMPLE)
    rows["time_s"] = 60.0 * number + np.arange(60)
    rows["voltage_v"], rows["current_a"], rows["temperature_c"] = 3.7, current_a, 25.0
    return encode(Block(STORE_ID_NS, number, 1, STORE_ID_NS / 1e9 + 60.0 * number, rows, cells_v))


def row_of_an_hour(cells_of_minute, take_over=False):
    """Return the row of an hour whose minutes have these cell voltages; every second minute is a rest."""
    partition = Partition(0, table)
    for number in range(1, 61):
        data = minute(number, 0.0 if number % 2 else 2.0, cells_of_minute(number))
        hours = partition.take("a", data, number).hours
        if take_over:
            partition = Partition.restore(0, table, b"".join(partition.snapshot().chunks()))
    ((_, row),) = hours
    return Hour.model_validate_json(row)


def cells(number):
    under_load = 1.0 if number % 2 else 2.0  # deviations are doubled under load
    return 3.7 + under_load * np.tile(DEVIATIONS_V, (60, 1))


def test_row_has_spread_weakest_cell_and_deviations_at_rest():
    row = row_of_an_hour(cells)
    assert row.weakest_cell == 2
    # 30 minutes of rest and 29 of load: the block of minute 60 begins the next hour
    mean_factor = (30 + 2 * 29) / 59
    assert row.weakest_cell_v == pytest.approx(-0.030 * mean_factor)
    assert row.cell_spread_v == pytest.approx(0.045 * mean_factor)
    assert row.cells_rest_v == pytest.approx(DEVIATIONS_V.tolist())


def test_row_does_not_depend_on_takeovers():
    assert row_of_an_hour(cells, take_over=True) == row_of_an_hour(cells)


def test_row_of_a_pack_without_cell_voltages_has_no_values_of_cells():
    row = row_of_an_hour(lambda _: NO_CELLS)
    assert (row.cell_spread_v, row.weakest_cell, row.weakest_cell_v, row.cells_rest_v) == (None,) * 4


def test_cell_voltages_do_not_change_the_state_of_the_estimator():
    partition = Partition(0, table)
    for number in range(1, 4):
        partition.take("with", minute(number, 1.0, cells(1)), 2 * number - 1)
        partition.take("without", minute(number, 1.0, NO_CELLS), 2 * number)
    states = [partition.state(pack)["estimator"].tobytes() for pack in ("with", "without")]
    assert states[0] == states[1]
