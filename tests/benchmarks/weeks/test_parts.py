"""Each part of the ablation over weeks changes the estimates, so that no line of its table is without effect."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from bms_estimator.pack_model import fit
from tests.benchmarks.weeks.parts import FEW_ROWS, NOTHING, PARTS
from tests.benchmarks.weeks.runs import run_without, score_without
from tests.conftest import SHARED_DATA
from tests.estimator.anywhere.score import score
from tests.estimator.anywhere.use import DAY_S, drive
from tests.estimator.month import uses
from tests.estimator.month.cases import Case, Recording
from tests.estimator.month.sources import SOLAR
from tests.estimator.month.uses import HOUR_S, SOLAR_STEP_S, Phase, Use
from tests.fit_interval import fits_every

pytestmark = pytest.mark.thorough

CASE = Case("LFP", "everything", SOLAR, declared_ah=20.0, days=3)
INTERVAL_S = 1.25 * DAY_S
"""Interval between two fits [s], so that the second fit has a history with merged rows."""


def everything(rng, pack):
    """Yield discharges to the cut-off, full charges, unseen charges, long rests, and gaps of 10 min, over which the usual load links
    the SOC, at -5 to 30 C: samples for every part."""
    hour = HOUR_S // SOLAR_STEP_S
    # every third cycle has a discharge to the cut-off; in the next cycle the charge is unseen
    for count in itertools.count():
        room_c = rng.uniform(-5.0, 30.0) if count % 3 else 25.0
        yield Phase(drive(rng, pack.one_c, 0.3, 3 * hour), "empty", 0.15, room_c)
        yield Phase(np.zeros(hour), room_c=room_c)
        if count % 3 == 0:
            yield Phase(np.full(12 * hour, 0.15 * pack.one_c), "stopped")
            yield Phase(np.zeros(hour))
        yield Phase(np.full(12 * hour, -0.11 * pack.one_c), "stopped", is_seen=count % 3 != 1)
        yield Phase(np.zeros(3 * hour))
        yield Phase(np.zeros(hour // 6), is_seen=False)
        yield Phase(np.zeros(3 * hour))


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Return samples of the days of ``CASE``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(uses.USES, CASE.use, Use(everything, step_s=SOLAR_STEP_S))
        return CASE.draw(SHARED_DATA)


@pytest.fixture(autouse=True, scope="module")
def few_fits() -> Iterator[None]:
    """Fit at ``INTERVAL_S`` only, and begin each fit at three starts."""
    with fits_every(INTERVAL_S), pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "STARTS", fit.STARTS[:3])
        yield


@pytest.fixture(scope="module")
def estimates(recording: Recording, few_fits: None) -> np.ndarray:
    """Return SOC and std of the SOC with all parts."""
    return np.array(run_without(CASE, recording, PARTS[NOTHING], INTERVAL_S)[1:])


@pytest.mark.parametrize("name", [name for name in PARTS if name != NOTHING])
def test_each_part_changes_the_estimates(recording, estimates, name: str) -> None:
    changed = np.array(run_without(CASE, recording, PARTS[name], INTERVAL_S)[1:])
    assert np.isfinite(changed).all()
    assert np.abs(changed - estimates).max() > 1e-6


def test_merging_old_rows_differs_from_dropping_them(recording) -> None:
    merged, dropped = (
        run_without(CASE, recording, part, INTERVAL_S) for name, part in PARTS.items() if str(FEW_ROWS) in name
    )
    assert np.abs(merged[1] - dropped[1]).max() > 1e-6


def test_a_part_is_disabled_in_its_run_only(recording, estimates) -> None:
    run_without(CASE, recording, PARTS["hysteresis"], INTERVAL_S)
    assert np.array_equal(np.array(run_without(CASE, recording, PARTS[NOTHING], INTERVAL_S)[1:]), estimates)


def test_the_score_is_that_of_the_last_days(recording) -> None:
    time_s, soc, soc_std = run_without(CASE, recording, PARTS["slow fit"])
    is_last = time_s >= (CASE.days - 1) * DAY_S
    true_soc = recording.truth["soc"][np.searchsorted(recording.samples["time_s"], time_s)]
    expected = score(time_s[is_last], soc[is_last], soc_std[is_last], true_soc[is_last], after_s=0.0)
    assert expected is not None
    assert score_without(CASE, recording, PARTS["slow fit"], first_day=CASE.days) == expected
