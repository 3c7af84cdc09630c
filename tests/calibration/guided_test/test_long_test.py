"""Long guided test of a simulated pack, from the charge to the last rest."""

import numpy as np
import pytest

from bms_estimator.calibration.guided_test.guided_test import GuidedTest, Phase
from bms_estimator.calibration.guided_test.plan import LONG, Limits
from bms_estimator.calibration.ocv.relaxation_test import relaxation_test
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each
from bms_estimator.model.arrays import SAMPLE
from tests.end_to_end.lfp_pack import (
    CAPACITY_FACTOR,
    CHARGER_END_A,
    FULL_V,
    RATED_AH,
    SERIES,
    Connected,
    LfpPack,
    true_cell,
)

LIMITS = Limits(
    capacity_ah=RATED_AH,
    series_count=SERIES,
    full_v=FULL_V,
    tail_a=CHARGER_END_A,
    cutoff_v=10.0,
    min_cell_v=2.5,
    max_cell_v=3.7,
    max_discharge_a=6.0,
    max_temperature_c=60.0,
)
CONNECTED = {Phase.CHARGE: Connected.CHARGER, Phase.DISCHARGE: Connected.LOAD}


def follow_instructions(test, pack):
    """Connect what the test requires until it is done; return the samples, one per second."""
    rows = []
    while not test.is_done:
        pack.connect(CONNECTED.get(test.phase, Connected.NOTHING), test.load_a)
        reading = pack(float(len(rows)))
        row = np.zeros(1, dtype=SAMPLE)
        row["time_s"], row["current_a"], row["voltage_v"] = len(rows), reading.current_a, reading.voltage_v
        rows.append(row)
        test.feed(row)
    return np.concatenate(rows)


@pytest.mark.thorough
def test_the_long_test_measures_the_ocv_in_rests_down_to_the_cut_off() -> None:
    pack, test = LfpPack(0.9, charger_a=1.0), GuidedTest(LONG, LIMITS)
    samples = follow_instructions(test, pack)
    capture = samples[samples["time_s"] >= test.begin_s]
    rests = relaxation_test(capture, CAPACITY_FACTOR * RATED_AH, name="long", series_count=SERIES).rests
    # full, after 3 %, after each 5 % of the rated capacity until the true one, 92 % of it, is drawn, and empty
    assert len(rests) == len(test.points) == 1 + 1 + 18 + 1
    is_low = capture["voltage_v"] <= LIMITS.cutoff_v
    assert is_low.any()
    assert (capture["time_s"][is_low] > rests[-2].start_s).all()
    ends_s = [rest.start_s + rest.duration_s for rest in rests]
    true_soc = np.interp(ends_s, *np.array(pack.history).T)
    drawn_soc = 1.0 - np.array([rest.soc for rest in rests])
    assert drawn_soc == pytest.approx(true_soc[0] - true_soc, abs=1e-3)
    ocv_v = np.array([rest.ocv_v for rest in rests]) / SERIES
    assert ocv_v == pytest.approx(ocv_of_each(true_soc, *ocv_grid(true_cell())), abs=0.01)
