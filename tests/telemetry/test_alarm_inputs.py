"""Loss of a measured quantity, and the end of the loss."""

import json
from collections.abc import Sequence

import numpy as np
import pytest

from bms_estimator.kernels.alarms.quantities import update_quantities
from bms_estimator.kernels.alarms.records import ALARMS, EVALUATION_IO, LIMITS, LOG, NAMES, SETTINGS, TEMPERATURE
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.telemetry.alarms.definitions import decode


def change_times_s(present: Sequence[bool], steps_s: float, lost_s: float = 10.0, *, lost: bool = True) -> list[float]:
    """Return the times at which an alarm that needs the temperature is no longer watched, or watched again.

    Args:
        present: True for each sample with a temperature.
        steps_s: Interval between samples, the first of which is at 0 [s].
        lost_s: Time without values after which the temperature is lost [s].
        lost: True if the temperature is lost before the first sample.
    """
    alarms, limits, part, log = (
        np.zeros(1, ALARMS),
        np.zeros(len(NAMES), LIMITS),
        np.zeros(1, EVALUATION_IO),
        np.zeros(9, LOG),
    )
    limits["monitored"][0], limits["needs"][0] = 1, 1 << TEMPERATURE
    settings, samples, scratch = np.zeros(1, SETTINGS), np.zeros(1, SAMPLE), np.zeros((6, 1))
    settings["lost_s"], alarms["states"]["unwatched"][0, 0] = lost_s, lost
    alarms["quantities"]["max_count"][0, TEMPERATURE], alarms["quantities"]["lost"][0, TEMPERATURE] = 1, lost
    scratch[0] = steps_s
    for i, is_present in enumerate(present):
        samples["time_s"], scratch[1 + TEMPERATURE] = i * steps_s, is_present
        update_quantities(alarms, limits, settings, part, samples, scratch, log, i * steps_s)
    times_s: list[float] = log["at_s"][: part["logged"][0]].tolist()
    return times_s


@pytest.mark.parametrize(
    ("present", "step_s", "restored_s"),
    [
        ([True] * 100, 1.0, 10.0),
        ([True] * 5, 60.0, 60.0),  # one sample a minute
        ([True, False, False, False, False] * 10, 1.0, 10.0),  # a value every 5 s
        ([True] * 9 + [False] * 7 + [True] * 50, 1.0, 26.0),
    ],
)
def test_a_loss_ends_after_ten_seconds_of_samples_with_values(
    present: list[bool], step_s: float, restored_s: float
) -> None:
    assert change_times_s(present, step_s) == [restored_s]


@pytest.mark.parametrize(
    ("present", "step_s"),
    [
        ([True] + [False] * 200, 1.0),
        (([True] + [False] * 42) * 50, 0.2),  # a value every 8.6 s
        ([True, False] * 50, 4.3),
        ([True, False] * 50, 60.0),
        (([True] * 9 + [False] * 7) * 20, 1.0),
        ([True] * 9, 1.0),
    ],
)
def test_rare_values_do_not_end_a_loss(present: list[bool], step_s: float) -> None:
    assert change_times_s(present, step_s) == []


def test_a_loss_ends_after_ten_seconds_of_values_also_if_it_begins_sooner() -> None:
    present = [True] * 3 + [False] * 3 + [True] * 20
    # the first missing value is at 3 s, the first one after the loss at 6 s
    assert change_times_s(present, 1.0, lost_s=1.0, lost=False) == [4.0, 16.0]


def test_gaps_count_neither_for_a_loss_nor_for_its_end() -> None:
    assert change_times_s([True] * 50, 0.0) == []


def test_state_of_a_pack_with_more_cells_is_restored() -> None:
    assert decode(json.dumps({"inputs": {"cells": [16, True]}}), series=2).counts["cells"] == (2, True)
