"""Topic ``parameters``: units, standard deviations and validity of a1..a15."""

import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.telemetry.parameters import make_parameters_payload

SERIES_FACTOR = {"ohm": 6.0, "V": 6.0, "F": 1.0 / 6.0, "1": 1.0}
"""Factor of a parameter of six cells in series relative to that of one cell, by unit."""


def test_each_parameter_has_the_unit_in_which_it_scales_with_the_number_of_cells() -> None:
    cell = load_cell("chen_mora")
    reports = [make_parameters_payload(Estimator(cell.pack(series, 1)), 0.0) for series in (1, 6)]
    assert list(reports[0].a) == [f"a{i}" for i in range(1, 22)]
    for name, one in reports[0].a.items():
        six = reports[1].a[name]
        assert one.unit == six.unit
        assert six.value == pytest.approx(SERIES_FACTOR[one.unit or ""] * (one.value or 0.0)), name
