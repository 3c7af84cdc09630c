"""State folder and Home Assistant entities of the version before: an owner's pack keeps what it learned, alarms and entities."""

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from structlog.testing import capture_logs

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.estimator.identified_parameters import relative_capacity, relative_series_resistance
from bms_estimator.kernels.kalman_filter.records import LN_Q
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import Pack, new_pack
from bms_estimator.process.boot_timestamp import BootTimestamp
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.settings.connections import Command, HomeAssistantSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.sinks.home_assistant.discovery import DiscoveryInputs, discovery, discovery_topic
from tests.patience import LONG_S
from tests.scripted_source import Collector, ScriptedSource
from tests.sinks.snapshots import CELL_SNAPSHOT, STACK_SNAPSHOT

DATA = Path(__file__).parents[1] / "data" / "version_before"
BEFORE: dict[str, Any] = json.loads((DATA / "expected.json").read_text())
CAPACITY_AH = 22.0
"""Capacity with which the version before ran. The cells have 20 Ah."""
NEXT_BOOT = BootTimestamp(1_796_102_400.0, True, 0.0, "boot")
"""Time of the present run, about an hour later. The clock of the run before was not synchronised."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a copy of the state folder."""
    return shutil.copytree(DATA, tmp_path / "state")


def files(folder: Path, capacity_ah: float) -> tuple[Settings, StateFiles, Pack]:
    """Return settings, files and new pack with a declared capacity."""
    settings = Settings.model_validate(
        {
            "pack": {"name": "boat", "cell": "nmc", "series": 6, "capacity_ah": capacity_ah},
            "identifier": {"fit_interval_s": 36000},
            "alarms": {"over_temperature": {"limit_c": 55.0, "latch": True}},
        }
    )
    model = load_cell("nmc", capacity_ah).pack(6, 1)
    return settings, StateFiles(folder, settings, model, lambda: NEXT_BOOT), new_pack(settings, model)


def learned(pack: Pack, capacity_ah: float) -> tuple[float, float]:
    """Return the learned capacity [Ah], and the series resistance relative to that of the cell file with ``CAPACITY_AH``."""
    e = pack.estimator
    r_s = relative_series_resistance(e.record[0], e.settings_record[0], e.cell_file_settings)
    return relative_capacity(e.record[0]).value * capacity_ah, r_s.value * CAPACITY_AH / capacity_ah


def test_what_was_learned_is_restored_whole(folder: Path) -> None:
    _, saved, pack = files(folder, CAPACITY_AH)
    state = saved.read()
    outcomes = pack.restore(state, state.gap_s)
    assert (state.reasons, set(outcomes)) == ({}, {"checkpoint", "history", "load"})
    assert all(outcome.startswith("restored") for outcome in outcomes.values())
    assert pack.estimator.soc == BEFORE["soc"]
    assert learned(pack, CAPACITY_AH) == pytest.approx((BEFORE["capacity_ah"], BEFORE["r_s_ratio"]), rel=1e-9)
    assert pack.slow_fit
    assert pack.slow_fit.fit
    assert pack.slow_fit.history.rows.size == BEFORE["history_rows"]
    np.testing.assert_array_equal(pack.slow_fit.fit.curve_v, state.history["curve_v"])
    assert pack.forecaster
    np.testing.assert_array_equal(pack.forecaster.past.mean_a.astype("f4"), state.load["minutes_mean_a"])
    assert pack.cells
    assert pack.cells.deviations
    for name in ("resistance_ratio", "self_discharge_a"):
        np.testing.assert_allclose(getattr(pack.cells.deviations, name), BEFORE[f"cell_{name}"], rtol=1e-9)
    np.testing.assert_allclose(pack.cells.deviations.soc, BEFORE["cell_soc"], rtol=1e-9)


def test_a_corrected_capacity_keeps_soc_and_what_was_learned(folder: Path) -> None:
    _, saved, pack = files(folder, 20.0)
    assert saved.restore(pack).startswith("restored")
    assert pack.estimator.soc == BEFORE["soc"]
    f, capacity_std = pack.estimator.record[0]["filter"], pack.estimator.cell_file_settings["capacity_std"]
    not_learned = f["covariance"][f["best"], LN_Q, LN_Q] / capacity_std**2  # this part follows the declared capacity
    assert not_learned < 0.6
    expected = BEFORE["capacity_ah"] * (20.0 / CAPACITY_AH) ** not_learned, BEFORE["r_s_ratio"]
    assert learned(pack, 20.0) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("capacity_ah", [CAPACITY_AH, 20.0], ids=["unchanged", "corrected"])
async def test_the_service_keeps_totals_and_the_latched_alarm(folder: Path, capacity_ah: float) -> None:
    settings, saved, _ = files(folder, capacity_ah)
    source, sink, model = ScriptedSource(), Collector(), load_cell("nmc", capacity_ah).pack(6, 1)
    source.give((0.0, 0.0, 24.3, 25.0, 0), (1.0, 0.0, 24.3, 25.0, 0))
    source.finish()
    run = run_estimation_loop(settings, model, source=source, sinks=[sink], stop=asyncio.Event(), files=saved)
    with capture_logs() as lines:
        await asyncio.wait_for(run, LONG_S)
    assert not [line for line in lines if str(line.get("outcome", "")).startswith("refused")]
    assert [alarm.name for alarm in sink.snapshots[-1].alarms if alarm.active] == ["over_temperature"]
    after = saved.read_counters().counters
    before, total = BEFORE["total"], after.total.model_dump()
    assert (after.restarts, total["since"]) == (2, before["since"])
    assert total["samples"]["samples"] == before["samples"]["samples"] + 2
    for name in ("charge_out_ah", "charge_in_ah", "energy_out_kwh", "energy_in_kwh"):
        assert total[name] == before[name]


@pytest.mark.parametrize(("kind", "info"), [("battery", CELL_SNAPSHOT.info), ("fuel_cell", STACK_SNAPSHOT.info)])
def test_no_entity_of_home_assistant_disappears(kind: str, info: Any) -> None:
    inputs = DiscoveryInputs(info, 6, ALARMS, get_args(Command))
    components = discovery(HomeAssistantSettings(), inputs, "bms/pack", 0.0)["components"].values()
    present = {f"{each['platform']}.{each['unique_id']}" for each in components if "unique_id" in each}
    assert set(BEFORE[f"{kind}_entities"]) - present == set()
    assert discovery_topic(HomeAssistantSettings(), "pack") == BEFORE["discovery_topic"]
