"""The identifier's promises: it converges, knows how far to trust itself, and lives through bad input."""

from pathlib import Path

import numpy as np
import pytest

from tests.kernels import identifier_cases as cases

TWICE, HALF = (2.0,) * 5, (0.5,) * 5
MIXED, OPPOSED = (2.0, 0.5, 2.0, 2.0, 0.5), (0.5, 2.0, 0.5, 0.5, 2.0)
STARTS = [
    ("cell1_random_steps", (2.0, 2.0, 0.5, 0.5, 0.5)),
    ("cell1_random_steps", OPPOSED),
    ("cell5_random_steps", TWICE),
    ("cell5_random_steps", OPPOSED),
    ("cell5_relaxation_c2", TWICE),
    ("cell5_relaxation_c2", OPPOSED),
    ("cell1_hppc", MIXED),
    ("cell5_hppc", OPPOSED),
    ("cell1_dst", TWICE),
    ("cell1_dst", HALF),
]


@pytest.mark.parametrize(("name", "factors"), STARTS)
def test_real_cells_from_a_wrong_start(shared_data: Path, name: str, factors: tuple[float, ...]) -> None:
    """SOC wrong by 0.20, every resistance and time constant by a factor of two."""
    run = cases.identify_capture(shared_data, name, factors)
    dst = name.endswith("dst")
    assert run.soc_rms_percent(3600.0) <= (0.9 if dst else 0.35)
    assert run.coverage() >= 0.9
    assert run.innovation_rms_mv(3600.0) <= (5.0 if dst else 2.2)
    judged = run.after(1800.0)
    assert np.abs(run.error[judged]).max() < 0.02
    tau_ts, tau_tl = run.trace["ln"][:, 2], run.trace["ln"][:, 4]
    assert (tau_tl - tau_ts).min() > np.log(3.5)
    assert np.exp(tau_ts[judged]).min() > 5.0
