"""``forecast``: from the checkpoint of a pack, and from the end of a capture."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.checkpoint.arrays_file import LOAD_SUFFIX
from bms_estimator.checkpoint.state_files import CheckpointFile, StateFiles
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import new_pack
from bms_estimator.pack.state import CHECKPOINT, LOAD
from bms_estimator.simulation.simulated_pack import SimulatedPack, random_steps
from tests.command_line import error, run

CELL = "ncr18650"


@pytest.fixture(scope="module")
def samples() -> SampleBlock:
    """Return ten minutes of a simulated cell under a changing load from SOC 0.7, at 1 Hz."""
    simulated = SimulatedPack(load_cell(CELL), random_steps(3.0, seed=4), soc=0.7)
    samples = np.zeros(600, SAMPLE)
    samples["temperature_c"] = 25.0
    for second, row in enumerate(samples):
        reading = simulated(float(second))
        row["time_s"], row["current_a"], row["voltage_v"] = second, reading.current_a, reading.voltage_v
    return samples


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory, samples: SampleBlock) -> Path:
    """Write a pack file, and the checkpoint and the load that a service saved after the samples."""
    folder = tmp_path_factory.mktemp("pack")
    file = folder / "pack.toml"
    file.write_text(
        f'[pack]\nname = "bike"\ncell = "{CELL}"\ninitial_soc = 0.7\ncutoff_v = 2.8\n[state]\nfolder = "{folder / "state"}"\n'
    )
    settings, cell = load_pack(file)
    pack = new_pack(settings, cell)
    pack.run(samples)
    StateFiles(folder / "state", settings, cell).save(pack.state(CHECKPOINT, LOAD))
    return file


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory, samples: SampleBlock) -> Path:
    """Write the samples as a capture."""
    path = tmp_path_factory.mktemp("capture") / "ride.csv"
    rows = "".join(f"{row['time_s']},{row['current_a']},{row['voltage_v']},25.0\n" for row in samples)
    path.write_text(f"time_s,current_a,voltage_v,temperature_c\n{rows}")
    return path


@pytest.fixture(scope="module")
def trip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a profile of ten minutes."""
    path = tmp_path_factory.mktemp("trip") / "trip.csv"
    path.write_text("time_s,power_w\n0,4\n300,12\n330,4\n600,0\n")
    return path


def copy_pack(pack: Path, folder: Path) -> Path:
    """Copy pack file and state to a folder. Return the pack file."""
    copy = folder / "pack.toml"
    copy.write_text(pack.read_text().replace(str(pack.parent), str(folder)))
    shutil.copytree(pack.parent / "state", folder / "state")
    return copy


def load_file(pack: Path) -> Path:
    """Return the path of the saved load."""
    return StateFiles(pack.parent / "state", *load_pack(pack)).load.path


def run_json(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    code, out, err = run(capsys, "forecast", *arguments, "--json")
    assert (code, err) == (0, "")
    return json.loads(out)


def test_forecast_of_a_trip_from_the_checkpoint(capsys: pytest.CaptureFixture[str], pack: Path, trip: Path) -> None:
    result = run_json(capsys, pack, "--load", trip)
    assert result["cutoff_v"] == 2.8
    assert result["reason"] is None
    assert 0.0 < result["time_to_cutoff_p05_s"] < result["time_to_cutoff_s"] < result["time_to_cutoff_p95_s"]
    outcome = result["trip"]
    assert (outcome["duration_s"], outcome["verdict"]) == (600.0, "enough")
    assert outcome["energy_wh"] == pytest.approx((4.0 * 570.0 + 12.0 * 30.0) / 3600.0)
    assert 0.3 < outcome["soc_p05"] < outcome["soc_p50"] < outcome["soc_p95"] < 0.7


def test_end_of_a_capture_gives_nearly_the_forecast_of_the_checkpoint(
    capsys: pytest.CaptureFixture[str], pack: Path, capture: Path
) -> None:
    """Only the random numbers differ."""
    saved = run_json(capsys, pack, "--power-w", 5)
    replayed = run_json(capsys, "--capture", capture, "--cell", CELL, "--cutoff-v", 2.8, "--power-w", 5)
    assert replayed["time_to_cutoff_s"] == pytest.approx(saved["time_to_cutoff_s"], rel=0.05)
    assert saved["trip"] is None


def test_without_a_load_the_saved_one_is_expected(capsys: pytest.CaptureFixture[str], pack: Path) -> None:
    result = run_json(capsys, pack)
    assert result["reason"] is None
    assert result["time_to_cutoff_s"] > 0.0


def test_without_a_saved_load_the_reason_is_printed(
    capsys: pytest.CaptureFixture[str], pack: Path, tmp_path: Path
) -> None:
    copy = copy_pack(pack, tmp_path)
    load_file(copy).unlink()
    code, out, _ = run(capsys, "forecast", copy)
    assert code == 0
    assert re.search(r"SOC now +\d+\.\d% ± \d+\.\d%", out)
    assert "unknown: less than 300 s of load have been seen" in out


def test_command_changes_no_file(capsys: pytest.CaptureFixture[str], pack: Path, trip: Path) -> None:
    def contents() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in (pack.parent / "state").iterdir()}

    before = contents()
    run_json(capsys, pack, "--load", trip)
    assert contents() == before


def test_table_shows_the_verdict_and_the_age_of_the_state(
    capsys: pytest.CaptureFixture[str], pack: Path, trip: Path
) -> None:
    code, out, err = run(capsys, "forecast", pack, "--load", trip)
    assert (code, err) == (0, "")
    for text in ("bike", "saved", "ago", "trip.csv, 10 minutes", "time to 2.8 V", "enough, probability 100%", "Wh"):
        assert text in out


def test_plot_is_written_and_not_overwritten(
    capsys: pytest.CaptureFixture[str], pack: Path, trip: Path, tmp_path: Path
) -> None:
    arguments = ("forecast", pack, "--load", trip, "--plot", tmp_path / "trip.png")
    assert run(capsys, *arguments)[0] == 0
    assert (tmp_path / "trip.png").read_bytes().startswith(b"\x89PNG")
    code, _, err = run(capsys, *arguments)
    assert (code, "--plot" in err, "exists already" in err) == (2, True, True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give the settings file of a pack, or --capture FILE --cell NAME"),
        (["PACK", "--power-w", "5", "--current-a", "1"], "--current-a and --power-w: give one of them"),
        (["PACK", "--duration-s", "60"], "--duration-s: belongs to --current-a or --power-w"),
        (["PACK", "--load", "none.csv"], "none.csv: no such file"),
        (["PACK", "--power-w", "5", "--cutoff-v", "9"], "must be below"),
        (["PACK", "--power-w", "5", "--cutoff-v", "0"], "pack.cutoff_v = 0.0: must be "),
        (["PACK", "--power-w", "5", "--plot", "x.txt"], "must end in .png, .svg, .pdf"),
        (["--capture", "none.csv", "--cell", CELL], "none.csv: no such file"),
        (["--capture", "none.csv"], "give either --cell NAME"),
    ],
)
def test_invalid_arguments_are_reported(
    capsys: pytest.CaptureFixture[str], pack: Path, arguments: list[str], message: str
) -> None:
    code, out, err = run(capsys, "forecast", *(pack if argument == "PACK" else argument for argument in arguments))
    assert (code, out) == (2, "")
    assert message in err


def test_missing_checkpoint_is_reported(capsys: pytest.CaptureFixture[str], pack: Path, tmp_path: Path) -> None:
    other = tmp_path / "pack.toml"  # names the state folder of ``pack``, which contains no checkpoint of this cell
    other.write_text(pack.read_text().replace("ncr18650", "chen_mora"))
    err = error(run(capsys, "forecast", other, "--power-w", 5))
    assert "no checkpoint to read: none found; the pack's service saves a checkpoint every" in err


def test_checkpoint_of_another_pack_is_reported(capsys: pytest.CaptureFixture[str], pack: Path, tmp_path: Path) -> None:
    other = tmp_path / "pack.toml"
    other.write_text(pack.read_text().replace("ncr18650", "chen_mora").replace(str(pack.parent), str(tmp_path)))
    (tmp_path / "state").mkdir()
    settings, cell = load_pack(other)
    [checkpoint] = [path for path in (pack.parent / "state").iterdir() if not path.name.endswith(LOAD_SUFFIX)]
    CheckpointFile(tmp_path / "state", settings, cell).path.write_bytes(checkpoint.read_bytes())
    assert "it belongs to another pack or cell" in error(run(capsys, "forecast", other, "--power-w", 5))


def test_damaged_load_is_reported_and_a_given_load_still_works(
    capsys: pytest.CaptureFixture[str], pack: Path, tmp_path: Path
) -> None:
    copy = copy_pack(pack, tmp_path)
    load_file(copy).write_bytes(b"damaged")
    code, out, err = run(capsys, "forecast", copy, "--power-w", 5)
    assert (code, "time to 2.8 V" in out) == (0, True)
    assert "the observed load is unknown: damaged" in err
