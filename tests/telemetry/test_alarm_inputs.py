"""Loss of a measured quantity, and the end of the loss."""

import numpy as np
import pytest

from bms_estimator.telemetry.alarms.inputs import Inputs


def change_times_s(present: list[bool], step_s: float, inputs: Inputs) -> list[float]:
    """Return the times at which the temperature was lost or measured again, with samples every ``step_s`` from 0 on."""
    times_s = step_s * np.arange(len(present))
    one = np.ones(len(present), dtype=np.int64)
    counts = {"voltage": one, "current": one, "cells": one, "temperature": np.array(present, dtype=np.int64)}
    return inputs.update(times_s, np.full(len(present), step_s), counts)


def inputs_without_temperature() -> Inputs:
    """Return the state of inputs that have lost the temperature."""
    inputs = Inputs(lost_s=10.0, series=2)
    inputs.restore({"temperature": [1, True]})  # one value per sample, and lost
    return inputs


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
    assert change_times_s(present, step_s, inputs_without_temperature()) == [restored_s]


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
def test_values_more_than_five_seconds_apart_do_not_end_a_loss(present: list[bool], step_s: float) -> None:
    assert change_times_s(present, step_s, inputs_without_temperature()) == []


def test_gaps_count_neither_for_a_loss_nor_for_its_end() -> None:
    inputs, one = inputs_without_temperature(), np.ones(50, dtype=np.int64)
    counts = {"voltage": one, "current": one, "cells": one, "temperature": one}
    # a duration of 0 marks a gap before the sample
    assert inputs.update(100.0 * np.arange(50), np.zeros(50), counts) == []
    assert inputs.lost == ("temperature",)


def test_state_of_a_pack_with_more_cells_is_restored() -> None:
    inputs = Inputs(lost_s=10.0, series=2)
    inputs.restore({"cells": [16, True]})
    # the stored number of cells is limited to that of the settings
    assert (inputs.lost, inputs.saved_state) == (("cells",), {"cells": [2, True]})
