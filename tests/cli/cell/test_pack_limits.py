"""Limits of a guided test from the settings of a pack."""

import pytest

from bms_estimator.cli.cell.calibrate_live import pack_limits
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.pack import Settings


@pytest.mark.parametrize(("pack", "limit_a"), [({}, 15.0), ({"max_discharge_a": 2.0}, 2.0)])
def test_no_current_of_a_guided_test_is_above_the_largest_current_of_the_pack(
    pack: dict[str, float], limit_a: float
) -> None:
    settings = Settings.model_validate({"pack": pack})
    assert pack_limits(settings, load_cell("ncr18650")).max_discharge_a == limit_a
