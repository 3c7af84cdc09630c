"""Topic ``parameters``: units, standard deviations and validity of a1..a15."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import SOC_GRID, ladder_of_branches
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import Ladder
from bms_estimator.model.payloads.snapshot import Parameter
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.telemetry.parameters import make_parameters_payload
from tests.estimator.simulated_cell import TRUTH, pulses

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


ELEMENT_STD = 0.35
"""Std of ln of an element of the drawn files, which the filter assumes for a file with two RC pairs."""
DRAWN_FILES = 16
CAPACITANCE_NAMES = [f"a{i}" for i in range(7, 13)]
"""Parameters of C_ts and C_tl."""


@pytest.fixture(scope="module")
def three_hours() -> SampleBlock:
    """Return samples of the true cell, discharged from full by pulses."""
    return pulses()[0]


def drawn_file(rng: np.random.Generator) -> CellModel:
    """Return the file of the true cell with each element multiplied by a random factor."""
    parts = {}
    for name in ("r_s", "r_ts", "r_tl", "c_ts", "c_tl"):
        part, factor = getattr(TRUTH, name), float(np.exp(rng.normal(0.0, ELEMENT_STD)))
        scaled = {key: factor * getattr(part, key) for key in part.model_dump() if key != "exponent"}
        parts[name] = part.model_copy(update=scaled)
    return TRUTH.model_copy(update=parts)


def parameters_after(cell: CellModel, block: SampleBlock) -> dict[str, Parameter]:
    """Return a1..a21 that an estimator with this file publishes after the samples."""
    estimator = Estimator(cell, identifier=IdentifierSettings(), initial_soc=1.0)
    estimator.run(block)
    return make_parameters_payload(estimator, 0.0).a


def test_valid_parameters_of_drawn_files_lie_within_two_stds(three_hours: SampleBlock) -> None:
    rng, errors = np.random.default_rng(1), []
    for _ in range(DRAWN_FILES):
        parameters = parameters_after(drawn_file(rng), three_hours)
        for i in range(1, 16):
            each = parameters[f"a{i}"]
            if each.valid:
                assert each.value is not None
                assert each.std is not None
                errors.append(abs(each.value - TRUTH.a[i]) / each.std)
    assert len(errors) > 3 * DRAWN_FILES  # at least the offsets of the resistances
    assert np.mean(np.array(errors) < 2.0) >= 0.9


def test_a_value_that_the_law_of_the_thesis_has_moved_is_not_said_to_be_from_the_cell_file(
    three_hours: SampleBlock,
) -> None:
    """The bounds of the thesis lead a1 from 180 ohm to 0.55 ohm; those of other files lie around the value of the file."""
    reasons = []
    for name in ("chen_mora", "ncr18650"):
        estimator = Estimator(load_cell(name), identifier=None, initial_soc=0.8)
        estimator.run(three_hours[:100])
        report = make_parameters_payload(estimator, 0.0)
        reasons.append((report.a["a1"].reason, report.elements["r_ts_ohm"].reason, report.a["a14"].reason))
    moved = "moved by the adaptive law of the thesis, which does not identify it"
    from_file = "from the cell file: no data has identified it"
    assert reasons == [(moved, moved, from_file), (from_file, from_file, from_file)]


def file_with_ladder(std: float) -> CellModel:
    """Return the file of the true cell with its exact RC ladder. The declared std says whether the ladder was fitted to data."""
    half_ohm = (0.5 * ladder_of_branches(TRUTH).T).tolist()
    ladder = Ladder.model_validate(
        {
            "soc": SOC_GRID.tolist(),
            "weak_ohm": half_ohm,
            "strong_ohm": half_ohm,
            "std": std,
            "error_v": 0.001,
            "temperature_c": (15.0, 35.0),
        }
    )
    return TRUTH.model_copy(update={"ladder": ladder})


@pytest.mark.parametrize(("ladder_std", "any_valid"), [(0.1, True), (0.35, False)])
def test_capacitances_are_valid_only_if_data_determined_the_time_constants(
    ladder_std: float, any_valid: bool, three_hours: SampleBlock
) -> None:
    parameters = parameters_after(file_with_ladder(ladder_std), three_hours)
    assert any(parameters[name].valid for name in CAPACITANCE_NAMES) == any_valid
    if not any_valid:
        reasons = [parameters[name].reason or "" for name in CAPACITANCE_NAMES]
        assert any("which give the time constants, have a std of 35%" in reason for reason in reasons), reasons
