"""A pack with all its stages: the same results for any division of the samples into blocks, to the last bit."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.pack.state import CHECKPOINT, HISTORY
from bms_estimator.pack_model import slow_fit as slow_fit_module
from bms_estimator.pack_model.cell_curves import SOC_GRID
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.simulated_pack import SimulatedPack as SimulatedLoad, constant
from tests.pack_model.quick_fit import quick_fit
from tests.simulated_pack import CAPACITY_AH, SimulatedPack

pytestmark = pytest.mark.usefixtures("few_draws")

HOURS, STEP_S = 4, 10.0


@pytest.fixture(scope="module")
def recording() -> tuple[np.ndarray, np.ndarray]:
    """Return samples of a discharge with rests, and the voltages of the cells. One sample is rejected."""
    pack = SimulatedPack()
    phase = np.arange(round(HOURS * 3600.0 / STEP_S))
    history = pack.bank.run(CAPACITY_AH * np.where(phase % 60 < 40, 0.2, 0.0), STEP_S)
    samples = history.samples(np.random.default_rng(1), 2e-3, 0.01)
    assert samples.dtype == SAMPLE
    samples["voltage_v"][700] = np.nan
    return samples, np.round(history.cell_v, 3)


def run_in_blocks(
    recording: tuple[np.ndarray, np.ndarray], size: int, *, has_forecasts: bool = True
) -> tuple[Pack, bytes, bytes]:
    """Return a pack after blocks of ``size`` samples, and all rows of its trace and forecasts."""
    samples, cells_v = recording
    pack = new_pack(Settings(), SimulatedPack().model, has_forecasts=has_forecasts)
    steps = []
    for begin in range(0, samples.size, size):
        step = pack.run(samples[begin : begin + size], cells_v[begin : begin + size])
        steps.append((step.trace.tobytes(), step.forecasts.tobytes()))
    traces, forecasts = zip(*steps, strict=True)
    return pack, b"".join(traces), b"".join(forecasts)


def test_estimates_forecasts_and_cells_do_not_depend_on_the_division_into_blocks(
    recording: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    # the slope of the OCV, on which the estimates of single cells depend, is not that of the cell file
    tilt_v = np.linspace(0.0, 0.05, SOC_GRID.size)
    monkeypatch.setattr(slow_fit_module, "fit", lambda *arguments: replace(quick_fit(*arguments), curve_v=tilt_v))
    monkeypatch.setattr(slow_fit_module, "MIN_THROUGHPUT_SOC", 0.0)
    whole, trace, forecasts = run_in_blocks(recording, recording[0].size)
    assert whole.slow_fit
    assert whole.slow_fit.fits >= 2  # in the middle of the only block
    assert whole.cells
    # without forecasts only fits divide the block, so that the single cells must run before a fit is adopted
    for size, has_forecasts in ((1, True), (613, True), (recording[0].size, False)):
        pack, other_trace, other_forecasts = run_in_blocks(recording, size, has_forecasts=has_forecasts)
        assert pack.slow_fit
        assert pack.slow_fit.fits == whole.slow_fit.fits
        assert other_trace == trace
        assert other_forecasts == forecasts or not has_forecasts
        assert pack.cells
        assert pack.cells.cells.tobytes() == whole.cells.cells.tobytes()


def test_the_soc_of_the_device_narrows_the_first_band_of_a_new_lfp_pack_unless_it_is_far_off() -> None:
    """The prior gives equal estimates for any division into blocks. An SOC that contradicts the voltage does not move the SOC."""
    settings = Settings.model_validate({"pack": {"cell": "lfp", "capacity_ah": 100, "device_soc_std": 0.1}})
    model = load_cell("lfp", 100.0).pack(16, 1)
    samples = np.zeros(120, SAMPLE)
    samples["time_s"], samples["current_a"] = np.arange(120.0), 20.0
    samples["voltage_v"], samples["temperature_c"] = SimulatedLoad(model, constant(20.0), soc=0.6)(60.0).voltage_v, 25.0
    device_soc = np.full(120, np.nan)
    device_soc[30:] = 0.62

    def last_row(soc: np.ndarray, size: int) -> np.void:
        pack = new_pack(settings, model)
        for begin in range(0, samples.size, size):
            part = slice(begin, begin + size)
            trace = pack.run(samples[part], device_soc=soc[part]).trace
        return trace[-1].copy()

    without, whole, far = last_row(device_soc[:0], 120), last_row(device_soc, 120), last_row(device_soc * 0.0, 120)
    assert whole["soc_std"] < 0.6 * without["soc_std"]
    assert abs(whole["soc"] - 0.6) < whole["soc_std"]
    assert last_row(device_soc, 7).tobytes() == last_row(device_soc, 1).tobytes() == whole.tobytes()
    assert far["soc"] > 0.2


def test_a_pack_without_forecasts_still_observes_the_load(recording: tuple[np.ndarray, np.ndarray]) -> None:
    pack = new_pack(Settings(), SimulatedPack().model, has_forecasts=False)
    step = pack.run(*recording)
    assert pack.forecaster
    assert np.isnan(step.forecasts["time_to_cutoff_s"]).all()
    assert pack.forecaster.load.seconds > 0
    assert pack.forecaster.past.mean_a.size > 0


def test_the_wait_for_the_first_sample_extends_the_gap_of_record_history_and_cells(
    recording: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slow_fit_module, "fit", quick_fit)
    before, model = new_pack(Settings(), SimulatedPack().model), SimulatedPack().model
    before.run(*recording)
    pack = new_pack(Settings(), model)
    outcomes = pack.restore(before.state(CHECKPOINT, HISTORY), 10.0)
    assert set(outcomes) == {"checkpoint", "history"}
    assert all(outcome.startswith("restored") for outcome in outcomes.values())
    assert pack.cells
    record, bank = pack.estimator.record, pack.cells.bank
    pack.extend_gap(2.0)
    pack.extend_gap(3.0)
    assert record["unseen_s"][0] == record["history"]["gap_s"][0] == bank["unseen_s"][0] == 15.0
    pack.run(recording[0][:1], recording[1][:1])
    pack.extend_gap(4.0)
    assert record["history"]["gap_s"][0] == 15.0
