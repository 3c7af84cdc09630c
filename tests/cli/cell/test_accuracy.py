"""``accuracy``: lower bound of the std of the SOC of a use, and the change that helps most."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.pack.pack import new_pack
from bms_estimator.pack_model.saved import history_arrays
from tests.command_line import error, run
from tests.estimator.anywhere.use import days
from tests.estimator.simulated_cell import TRUTH, measured

CELL = ("--cell", "lfp", "--capacity-ah", 280, "--between")


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a pack file, and the checkpoint and the history of a day."""
    folder = tmp_path_factory.mktemp("pack")
    file = folder / "pack.toml"
    file.write_text(
        f'[pack]\ncell = "nca"\ncapacity_ah = {TRUTH.cell.capacity_ah}\n[state]\nfolder = "{folder}"\n'
        "[identifier]\nfit_interval_s = 86400\n"
    )
    settings, model = load_pack(file)
    live, rng = new_pack(settings, model, has_forecasts=False), np.random.default_rng(2)
    current_a = days(rng, TRUTH.cell.capacity_ah, 1, 0.9).reshape(-1, 10).mean(axis=1)
    live.run(measured(current_a[:2000], 0.9, rng, step_s=10.0)[0])
    assert live.slow_fit
    live.slow_fit.take_rows()
    files = StateFiles(folder, settings, model)
    files.checkpoint.save(live.estimator.record)
    files.history.save(history_arrays(live.slow_fit.history, None))
    return file


def result_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Return the output of ``accuracy --json``."""
    code, out, err = run(capsys, "accuracy", *arguments, "--json")
    assert (code, err) == (0, "")
    return json.loads(out)


def test_a_full_charge_helps_an_lfp_pack_most(capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of(capsys, *CELL, 20, 90)
    assert next(iter(result["with_change"])) == "a full charge each week"
    assert result["with_change"]["a full charge each week"] < 0.5 * result["best_std"]
    assert result["present_std"] is None
    code, out, _ = run(capsys, "accuracy", *CELL, 20, 90)
    assert code == 0
    assert "A full charge each week helps most." in out


def test_a_window_up_to_full_has_full_charges(capsys: pytest.CaptureFixture[str]) -> None:
    assert "a full charge each week" not in result_of(capsys, *CELL, 20, 100)["with_change"]


def test_the_use_of_a_pack_comes_from_its_history(capsys: pytest.CaptureFixture[str], pack: Path) -> None:
    result = result_of(capsys, "--pack", pack)
    assert 0.0 < result["low"] < 0.7 < result["high"] < 1.0
    assert (result["full_charges"], result["has_temperature"]) == (0, True)
    assert result["best_std"] < result["present_std"]
    assert "a temperature sensor" not in result["with_change"]


def test_a_use_can_be_given_for_a_pack_without_a_history(capsys: pytest.CaptureFixture[str], pack: Path) -> None:
    history = StateFiles(pack.parent, *load_pack(pack)).history.path
    history.rename(history.with_suffix(".moved"))
    try:
        err = error(run(capsys, "accuracy", "--pack", pack))
        assert (
            "the history has a use from 37% to 37% only; give --between LOW HIGH" in err
        )  # the rows of the checkpoint
        assert result_of(capsys, "--pack", pack, "--between", 30, 80)["high"] == 0.8
    finally:
        history.with_suffix(".moved").rename(history)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give --pack pack.toml, or --cell NAME with --between LOW HIGH"),
        ((*CELL, 90, 20), "--between 90 20: give two SOCs from 0 to 100 with a distance of at least 5%"),
        (("--cell", "pem_30w", "--between", 20, 90), "a fuel cell has no SOC"),
    ],
)
def test_an_unusable_use_is_rejected(
    capsys: pytest.CaptureFixture[str], arguments: tuple[object, ...], message: str
) -> None:
    assert message in error(run(capsys, "accuracy", *arguments))
