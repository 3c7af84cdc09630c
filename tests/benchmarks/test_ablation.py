"""Ablation of the filter: the parts are settings that exist."""

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from tests.benchmarks.ablation import PARTS


def filter_settings_without(part: str) -> np.void:
    p: np.void = Estimator(load_cell("lfp", 3.0)).settings_record["filter"][0]
    PARTS[part](p)
    return p


def test_each_disabled_part_changes_the_settings_of_a_generic_cell() -> None:
    """A generic cell has no temperature coefficient of the OCV."""
    nothing = filter_settings_without("nothing").tobytes()
    unchanged = [part for part in PARTS if filter_settings_without(part).tobytes() == nothing]
    assert unchanged == ["nothing", "entropy"]
