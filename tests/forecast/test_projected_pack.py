"""Pack of the forecast: resistances towards empty, and the SOC gradient in the particles."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.forecast.capability import projected_pack
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.forecast.projected_pack import FAST_RESISTANCES, GROWTH, SURFACE_S
from bms_estimator.model.arrays import SAMPLE
from tests.estimator.simulated_cell import TRUTH
from tests.forecast.simulated_load import CUTOFF_V


def pack_at(soc: float, *, temperature_c: float = 25.0, largest_a: float = 0.0) -> tuple[np.void, np.void]:
    """Return the projected pack and the settings of the filter, after one sample at rest."""
    estimator = Estimator(TRUTH, initial_soc=soc)
    block = np.zeros(1, SAMPLE)
    block["voltage_v"], block["temperature_c"] = chen_mora.ocv(soc, *ocv_grid(TRUTH)), temperature_c
    estimator.run(block)
    return projected_pack(estimator, CUTOFF_V, largest_a)[0], estimator.settings_record[0]["filter"]


@pytest.mark.parametrize(("soc", "growth"), [(0.8, GROWTH), (0.2, 0.5 * GROWTH), (0.0, 0.0)])
def test_only_the_fast_resistances_grow_from_the_present_soc_to_empty(soc: float, growth: float) -> None:
    m, p = pack_at(soc)
    ratio = m["ohm"][:, 0] / (p["weak_ohm"] + p["strong_ohm"])[0]
    assert ratio[:FAST_RESISTANCES] / ratio[-1] == pytest.approx(1.0 + growth, rel=0.1)
    assert ratio[FAST_RESISTANCES:] == pytest.approx(ratio[-1])


def test_the_surface_of_the_particles_is_emptier_under_a_larger_peak_and_in_the_cold() -> None:
    peak_soc = {
        celsius: pack_at(0.8, temperature_c=celsius, largest_a=9.0)[0]["surface_soc"] for celsius in (25.0, -10.0)
    }
    assert peak_soc[25.0] == pytest.approx(SURFACE_S * 9.0 / (3600.0 * TRUTH.cell.capacity_ah), rel=0.01)
    assert peak_soc[-10.0] > 1.5 * peak_soc[25.0]
    assert pack_at(0.8)[0]["surface_soc"] == pytest.approx(0.0, abs=1e-3)
