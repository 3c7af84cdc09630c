"""Prior of the circuit elements: those of the most similar generic cell."""

import numpy as np
import pytest

from bms_estimator.calibration.elements.initial_elements import (
    RESTS_STD,
    InitialElements,
    curve,
    nearest_generic_cell,
    scaled_generic_ladder,
)
from bms_estimator.model.cell import load_cell
from bms_estimator.sources.captures.curves import read_curve

SOC = np.linspace(0.0, 1.0, 51)


@pytest.mark.parametrize("name", ["lfp", "lto", "nca"])
@pytest.mark.parametrize("series_count", [1, 4])
def test_nearest_generic_cell_has_the_chemistry_of_the_curve(name, series_count):
    cell_v = np.interp(SOC, *curve(load_cell(name, 1.0), "ocv_v")) + 0.01 * np.sin(9.0 * SOC)  # with an error of 10 mV
    result = nearest_generic_cell(SOC, series_count * cell_v, 7.0, series_count)
    assert result == load_cell(name, 7.0).pack(series_count, 1)


def test_nearest_generic_cell_of_a_real_layered_oxide_is_nca_or_nmc(data):
    soc, ocv_v, *_ = read_curve(data / "lgm50" / "ocv_25c.csv")
    assert nearest_generic_cell(soc, ocv_v, 5.0, 1).cell.name in {"nca", "nmc"}


def test_the_prior_ladder_has_the_resistances_of_the_rests_and_the_shape_of_the_generic_cell():
    generic = load_cell("nmc", 3.0)
    assert scaled_generic_ladder(generic, None) == generic.ladder
    result = scaled_generic_ladder(
        generic, InitialElements(r_s_ohm=0.05, r_ts_ohm=0.01, tau_ts_s=9.0, r_tl_ohm=0.02, tau_tl_s=300.0)
    )

    def ohm(ladder):
        """Return the resistances with weak and with strong temperature dependence."""
        return np.array(ladder.weak_ohm), np.array(ladder.strong_ohm)

    middle_ohm = sum(ohm(result))[:, result.soc.index(0.5)]
    assert middle_ohm[0] == pytest.approx(0.05, rel=1e-3)  # R_s
    assert middle_ohm[1:].sum() == pytest.approx(0.03, rel=1e-3)  # R_ts + R_tl
    for part, generic_part in zip(ohm(result), ohm(generic.ladder), strict=True):
        assert np.ptp(part / generic_part, axis=1) == pytest.approx(0.0, abs=2e-3)
    assert (result.std, result.temperature_c) == (RESTS_STD, generic.ladder.temperature_c)


def test_resistances_of_cold_rests_are_converted_to_25_c():
    """The rests of an 18650 NCA cell give R_s = 29 mohm and R_ts + R_tl = 39 mohm at 25 C, and 62 and 101 mohm at 0 C.

    The generic temperature dependence converts the values at 0 C to 27 and 37 mohm.
    """
    generic = load_cell("nca", 2.9)
    cold = scaled_generic_ladder(
        generic, InitialElements(r_s_ohm=0.0619, r_ts_ohm=0.05, tau_ts_s=9.0, r_tl_ohm=0.0507, tau_tl_s=300.0), 0.0
    )
    middle_ohm = (np.array(cold.weak_ohm) + np.array(cold.strong_ohm))[:, cold.soc.index(0.5)]
    assert middle_ohm[0] == pytest.approx(0.029, rel=0.2)
    assert middle_ohm[1:].sum() == pytest.approx(0.039, rel=0.2)
