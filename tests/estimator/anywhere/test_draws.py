"""Accuracy of the SOC interval over several random draws of load, cell file and noise for some cases.

Single captures did not show two faults of earlier versions: a full LFP cell was re-initialized on its plateau (error 20 %,
std 4 %), and hypotheses at the knee lost their weight at rest (error 40 %).
"""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from tests.estimator.anywhere.cases import CASES
from tests.estimator.anywhere.summary import rows

pytestmark = pytest.mark.thorough

SEEDS = range(100, 106)
LIMITS = {
    "full at -10C": (3.3, 4.2),
    "knows 25C at 0C": (1.4, 4.5),
    "knows 25C at -10C": (3.3, 8.1),
    "warms itself": (1.4, 3.1),
    "LFP full 25C": (1.6, 2.2),
    "LFP full -10C": (5.2, 7.0),
    "LFP cut 25C": (2.0, 4.1),
    # 4.0 and 3.2 with S in repeated updates; the likeliest variance keeps the true SOC at knees and plateaus (ablation_results.md)
    "LFP cut 0C": (4.2, 7.2),
    "generic nmc": (4.3, 6.7),
    "generic lfp": (2.7, 4.0),
}
"""Limits of the mean RMSE and of the mean std over all draws [%]."""
MIN_COVER = 95.0
"""Minimum of the mean share of time inside two std [%]."""


@pytest.mark.parametrize("name", LIMITS)
def test_interval_coverage_rmse_and_std_are_within_their_limits_on_other_draws(name: str) -> None:
    case = next(c for c in CASES if c.name == name)
    scores = [row.score for row in rows([replace(case, seed=seed) for seed in SEEDS])]
    max_rmse, max_std = LIMITS[name]
    assert np.mean([score.cover for score in scores]) >= MIN_COVER
    assert np.mean([score.rmse for score in scores]) <= max_rmse
    assert np.mean([score.std for score in scores]) <= max_std


def test_a_full_cell_at_rest_stays_full() -> None:
    """Half an hour at rest gives no new information, so that the hypotheses near full keep their weights.

    The initial SOC of 0.8 is wrong.
    """
    samples = np.zeros(1800, dtype=SAMPLE)
    samples["time_s"], samples["voltage_v"], samples["temperature_c"] = np.arange(1800.0), 3.575, 25.0
    trace = Estimator(load_cell("lfp", 2.0), initial_soc=0.8).run(samples)
    assert trace["soc"][-1] > 0.95
    assert trace["soc_std"][-1] < 0.1
