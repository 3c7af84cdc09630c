"""``cell export``: cell file from the learned state of a service, and a service that starts from it."""

import json
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.estimator.estimator import Estimator, compiled_estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import TableOcv
from tests.command_line import run
from tests.estimator.anywhere.cases import OXIDE, Case, capture

SERIES = 6
SETTLING = 900
"""Number of samples (15 min) after the start with a wrong SOC that are not compared."""
DECLARED_AH = 1.1 * OXIDE.capacity_ah
"""Capacity in the pack file, 10 % too large [Ah]."""


def simulate_discharge(seed: int, **changes: object):
    """Simulate a discharge of six equal cells from full, at 1 Hz. Return its samples and true SOC."""
    case = Case("", seed=seed, soc=1.0, load_before_h=0.0, hours=1.6, **changes)
    simulated = capture(case)
    simulated.samples["voltage_v"] *= SERIES
    return simulated


@pytest.fixture(scope="module")
def pack(tmp_path_factory) -> Path:
    """Write a pack file, and the checkpoint of a service after one discharge."""
    folder = tmp_path_factory.mktemp("pack")
    file = folder / "pack.toml"
    file.write_text(
        f'[pack]\ncell = "nmc"\ncapacity_ah = {DECLARED_AH}\nseries = {SERIES}\ninitial_soc = 1.0\n'
        f'[state]\nfolder = "{folder / "state"}"\n'
    )
    settings, cell = load_pack(file)
    estimator = compiled_estimator(settings, cell)
    estimator.run(simulate_discharge(1).samples)
    (folder / "state").mkdir()
    CheckpointFile(folder / "state", settings, cell).save(estimator.record)
    return file


@pytest.fixture(scope="module")
def exported(pack) -> Path:
    """Return the path to which the learned cell is exported."""
    return pack.with_name("learned.toml")


def test_file_contains_the_learned_values(capsys, pack, exported):
    code, text, err = run(capsys, "cell", "export", pack, "--out", exported, "--force", "--json")
    assert (code, err) == (0, "")
    result = json.loads(text)
    cell, generic = load_cell(exported), load_cell("nmc", DECLARED_AH)
    assert cell.cell.name == "learned"
    assert cell.cell.capacity_ah == pytest.approx(result["capacity_ah"], rel=1e-6)
    assert abs(cell.cell.capacity_ah - OXIDE.capacity_ah) < 2.0 * result["capacity_std_ah"]
    assert cell.cell.capacity_std < 0.08
    assert cell.cell.series_count == generic.cell.series_count == 1
    assert isinstance(cell.ocv, TableOcv)
    assert isinstance(generic.ocv, TableOcv)
    errors, generic_errors = np.array(cell.ocv.error_v), np.array(generic.ocv.error_v)
    assert (errors < generic_errors + 1e-9).mean() > 0.9
    true_v = np.interp(cell.ocv.soc, np.linspace(0.0, 1.0, OXIDE.ocv_v.size), OXIDE.ocv_v)
    deviation_v, generic_deviation_v = np.array(cell.ocv.ocv_v) - true_v, np.array(generic.ocv.ocv_v) - true_v
    inside = (np.array(cell.ocv.soc) > 0.3) & (np.array(cell.ocv.soc) < 0.95)
    assert np.sqrt(np.mean(deviation_v[inside] ** 2)) < np.sqrt(np.mean(generic_deviation_v[inside] ** 2))
    assert (np.abs(deviation_v[inside]) < 2.5 * errors[inside]).all()
    assert cell.ladder.std < 0.5 * generic.ladder.std
    assert cell.ladder.weak_ohm[0][0] / generic.ladder.weak_ohm[0][0] == pytest.approx(result["r_s_factor"], rel=1e-4)


def test_service_that_starts_from_the_exported_file_is_more_accurate(capsys, pack, exported):
    """In another discharge from an unknown SOC, the SOC error is smaller, and the interval is narrower and contains the SOC."""
    run(capsys, "cell", "export", pack, "--out", exported, "--force")
    simulated = simulate_discharge(2, load_c=0.4)
    begin = simulated.samples.size // 4
    samples, true_soc = simulated.samples[begin:], simulated.soc[begin:]
    results = []
    for cell in (load_cell(exported), load_cell("nmc", DECLARED_AH)):
        trace = Estimator(cell.pack(SERIES, 1), initial_soc=float(true_soc[0]) - 0.15).run(samples)[SETTLING:]
        error = trace["soc"] - true_soc[SETTLING:]
        results.append(
            (np.sqrt(np.mean(error**2)), trace["soc_std"].mean(), np.mean(np.abs(error) < 2.0 * trace["soc_std"]))
        )
    (rmse, std, coverage), (rmse_generic, std_generic, _) = results
    assert rmse < rmse_generic
    assert std < 0.9 * std_generic
    assert coverage > 0.95


def test_missing_checkpoint_is_an_error(tmp_path, capsys, pack):
    other = tmp_path / "pack.toml"
    other.write_text(pack.read_text().replace(str(pack.parent), str(tmp_path)))
    code, _, err = run(capsys, "cell", "export", other, "--out", tmp_path / "x.toml")
    assert code == 2
    assert "no checkpoint to read: none found" in err
    assert not (tmp_path / "x.toml").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("series = 6", "series = 5", "it belongs to another pack or cell"),
        ("nmc", "nca", "it belongs to another pack or cell"),
    ],
)
def test_checkpoint_of_another_pack_is_rejected(tmp_path, capsys, pack, old, new, message):
    other = tmp_path / "pack.toml"
    other.write_text(pack.read_text().replace(old, new))
    (saved,) = (pack.parent / "state").glob("*.npz")
    code, _, err = run(capsys, "cell", "export", other, "--out", tmp_path / "x.toml", "--checkpoint", saved)
    assert code == 2
    assert message in err
    assert saved.exists()


def test_checkpoint_of_another_format_is_rejected(tmp_path, capsys, pack):
    (saved,) = (pack.parent / "state").glob("*.npz")
    with np.load(saved) as file:
        fields = dict(file)
    np.savez(tmp_path / "later.npz", **(fields | {"format": 99}))
    code, _, err = run(
        capsys, "cell", "export", pack, "--out", tmp_path / "x.toml", "--checkpoint", tmp_path / "later.npz"
    )
    assert code == 2
    assert "format 99, this version reads" in err


def test_existing_file_is_replaced_only_with_force(tmp_path, capsys, pack):
    out = tmp_path / "mine.toml"
    out.write_text("mine")
    code, _, err = run(capsys, "cell", "export", pack, "--out", out)
    assert code == 2
    assert "exists already" in err
    assert out.read_text() == "mine"


def test_input_is_never_overwritten(capsys, pack):
    checkpoint = next((pack.parent / "state").glob("*.npz"))
    for out in (pack, checkpoint):
        content_before = out.read_bytes()
        code, _, err = run(capsys, "cell", "export", pack, "--checkpoint", checkpoint, "--out", out, "--force")
        assert code == 2
        assert "is also an input" in err
        assert out.read_bytes() == content_before
