"""A corrected ``capacity_ah`` keeps what was learned."""

from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.checkpoint.state_files import CheckpointFile, StateFiles
from bms_estimator.estimator.identified_parameters import relative_capacity, relative_series_resistance
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.pack_model import slow_fit as slow_fit_module
from bms_estimator.process.boot_timestamp import BootTimestamp
from bms_estimator.settings.pack import Settings
from tests.pack_model.quick_fit import LN_CAPACITY, quick_fit
from tests.simulated_pack import CAPACITY_AH, CELLS, SimulatedPack

pytestmark = pytest.mark.usefixtures("few_draws")

SETTINGS = Settings.model_validate({"pack": {"cell": "nmc", "series": CELLS}})


def model(capacity_ah: float) -> CellModel:
    """Return the model of a generic pack, whose resistances depend on its capacity."""
    return load_cell("nmc", capacity_ah).pack(CELLS, 1)


def files(folder: Path, capacity_ah: float, hour: int = 0) -> StateFiles:
    """Return the files of the pack with a declared capacity."""
    return StateFiles(
        folder, SETTINGS, model(capacity_ah), lambda: BootTimestamp(1e9 + 3600.0 * hour, True, 0.0, "boot")
    )


def run(pack: Pack, hours: float, start_s: float = 0.0) -> None:
    """Let a pack measure a simulated one."""
    bank = SimulatedPack().bank
    steps = np.arange(round(360 * hours))
    history = bank.run(CAPACITY_AH * np.where(steps % 60 < 40, 0.2, 0.0), 10.0)
    samples = history.samples(np.random.default_rng(1), 2e-3, 0.01)
    samples["time_s"] += start_s
    pack.run(samples, np.round(history.cell_v, 3))


def learned(pack: Pack, capacity_ah: float) -> tuple[float, float]:
    """Return the learned capacity [Ah] and the series resistance relative to a pack of 1 Ah."""
    estimator = pack.estimator
    r_s = relative_series_resistance(estimator.record[0], estimator.settings_record[0], estimator.cell_file_settings)
    return relative_capacity(estimator.record[0]).value * capacity_ah, r_s.value / capacity_ah


@pytest.mark.parametrize("wrong_ah", [0.5 * CAPACITY_AH, 1.5 * CAPACITY_AH])
def test_a_corrected_capacity_keeps_soc_curves_and_what_was_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong_ah: float
) -> None:
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit)
    monkeypatch.setattr(slow_fit_module, "MIN_THROUGHPUT_SOC", 0.0)
    before, after = new_pack(SETTINGS, model(wrong_ah)), new_pack(SETTINGS, model(CAPACITY_AH))
    run(before, 3.0)
    assert before.slow_fit
    assert before.slow_fit.fits
    files(tmp_path, wrong_ah).save(before.state())
    with capture_logs() as lines:
        assert files(tmp_path, CAPACITY_AH).restore(after) == f"restored: SOC {before.estimator.soc:.4f}"
    [line] = [line["outcome"] for line in lines if line["event"] == "capacity"]
    assert line.startswith(
        f"corrected from {wrong_ah:g} to {CAPACITY_AH:g} Ah; what is restored keeps its values in Ah and ohm"
    )
    assert float(after.estimator.state["soc"][0]) == before.estimator.soc
    f = before.estimator.record[0]["filter"]
    prior = f["covariance"][f["best"], LN_Q, LN_Q] / before.estimator.cell_file_settings["capacity_std"] ** 2
    assert 0.05 < prior < 0.2
    (before_ah, before_r_s), (after_ah, after_r_s) = learned(before, wrong_ah), learned(after, CAPACITY_AH)
    assert before_ah == pytest.approx(wrong_ah * np.exp(LN_CAPACITY), rel=0.02)
    assert after_ah == pytest.approx(before_ah * (CAPACITY_AH / wrong_ah) ** prior, rel=1e-9)
    assert after_r_s == pytest.approx(before_r_s, rel=1e-9)
    assert line.endswith(
        f": SOC {before.estimator.soc:.4f}, capacity {after_ah / CAPACITY_AH:.3f} of the declared one, and all totals"
    )
    for each in (before, after):
        assert each.slow_fit
        assert each.slow_fit.history.rows.size
    curves = [each.estimator.settings_record["filter"] for each in (before, after)]
    np.testing.assert_allclose(curves[1]["weak_ohm"], curves[0]["weak_ohm"], rtol=1e-9)
    assert before.cells
    assert after.cells
    assert before.cells.deviations
    assert after.cells.deviations
    np.testing.assert_allclose(after.cells.deviations.self_discharge_a, before.cells.deviations.self_discharge_a)
    run(after, 1.0, 1e4)
    assert after.slow_fit
    assert after.slow_fit.fits  # the history is fitted again
    assert after.slow_fit.failed == 0


def test_what_was_not_learned_follows_the_declared_capacity(tmp_path: Path) -> None:
    before, after = new_pack(SETTINGS, model(10.0)), new_pack(SETTINGS, model(20.0))
    run(before, 0.02)
    files(tmp_path, 10.0).save(before.state())
    files(tmp_path, 20.0).restore(after)
    f = after.estimator.record[0]["filter"]
    assert abs(f["mean"][f["best"], [LN_Q, LN_R]]).max() < 0.05


def test_the_newest_file_is_restored_after_a_return_to_an_earlier_capacity(tmp_path: Path) -> None:
    pack = new_pack(SETTINGS, model(10.0))
    run(pack, 0.02)
    files(tmp_path, 10.0).save(pack.state())
    corrected = new_pack(SETTINGS, model(20.0))
    files(tmp_path, 20.0).restore(corrected)
    corrected.estimator.set_soc(0.25)
    files(tmp_path, 20.0).save(corrected.state())
    back = new_pack(SETTINGS, model(10.0))
    assert files(tmp_path, 10.0).restore(back) == "restored: SOC 0.2500"
    assert files(tmp_path, 10.0).saved_pack().pack.estimator.state["soc"][0] == 0.25


def test_a_damaged_state_of_another_capacity_is_refused(tmp_path: Path) -> None:
    pack = new_pack(SETTINGS, model(10.0))
    run(pack, 0.02)
    files(tmp_path, 10.0).save(pack.state())
    path = files(tmp_path, 10.0).checkpoint.path
    with np.load(path) as content:
        arrays = dict(content)
    names = [name for name in arrays["state"].dtype.names if name != "filter"]
    np.savez(path, **{**arrays, "state": arrays["state"][names]})
    assert files(tmp_path, 20.0).restore(new_pack(SETTINGS, model(20.0))).startswith("refused: KeyError")
    assert not CheckpointFile(tmp_path, SETTINGS, model(10.0)).path.exists()
