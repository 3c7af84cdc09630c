"""Commands with a fuel cell: ``identify``, ``replay`` and ``config``, and errors of commands for batteries only."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.calibration.fuel_cell_fit import KEYS
from bms_estimator.kernels.cell_model.fuel_cell import open_loop, polarisation
from bms_estimator.model.pack_model import load_fuel_cell, write_cell
from tests import mann_stack
from tests.command_line import error, run

PEM = load_fuel_cell("pem_30w")
AGED = np.array([1.0, 1.3, *[1.0] * 14])
"""Factors of the kernel's parameters for an aged stack, whose resistance (index 1) is 30 % above that of the file."""


def write_csv(path: Path, **columns: np.ndarray) -> Path:
    """Write columns to a CSV file. Return its path."""
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.6g")
    return path


def with_negated_current(path: Path, folder: Path) -> Path:
    """Return a copy of the file with the opposite sign of the current."""
    rows = np.genfromtxt(path, delimiter=",", names=True)
    rows["current_a"] *= -1.0
    return write_csv(folder / f"negated_{path.name}", **{name: rows[name] for name in rows.dtype.names})


@pytest.fixture(scope="module")
def curve(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the polarization curve of the aged stack."""
    current_a = np.array([0, 0.05, 0.2, 0.5, 1, 2, 3, 4, 5, 6, 7, 8, 8.5])
    no_temperature = np.full(current_a.size, np.nan)
    voltage_v, _ = polarisation(PEM.a * AGED, np.zeros(8), current_a, no_temperature)
    return write_csv(tmp_path_factory.mktemp("fuel") / "curve.csv", current_a=current_a, voltage_v=voltage_v)


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a minute of the aged stack under steps of the current, at 200 Hz, with a noise of 3 mV."""
    time_s, current_a = mann_stack.random_steps(60.0, 200.0, seed=1)
    no_temperature = np.full(time_s.size, np.nan)
    voltage_v, _ = open_loop(PEM.a * AGED, np.zeros(8), time_s, current_a, no_temperature)
    voltage_v += np.random.default_rng(0).normal(0.0, 0.003, time_s.size)
    folder = tmp_path_factory.mktemp("fuel")
    return write_csv(folder / "steps.csv", time_s=time_s, current_a=current_a, voltage_v=voltage_v)


def test_identify_writes_a_cell_file_with_which_the_replay_has_smaller_innovations(
    capsys, curve: Path, steps: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mine.toml"
    code, printed, _ = run(capsys, "identify", curve, steps, "--cell", "pem_30w", "--out", out, "--json")
    assert code == 0
    result = json.loads(printed)
    assert set(result["parameters"]) == set(KEYS)
    r_ohm = result["parameters"]["r_ohm"]
    assert abs(r_ohm["value"] - 1.3 * r_ohm["of_start"]) < 3.0 * r_ohm["std"] < 0.05 * r_ohm["of_start"]
    assert result["steps_rms_mv"] == pytest.approx(3.0, rel=0.05)
    mine = load_fuel_cell(out)
    assert mine.cell.name == "mine"
    assert mine.std["r_ohm"] == pytest.approx(r_ohm["std"] / r_ohm["value"], rel=0.1)
    assert "Identified from curve" in out.read_text()
    rms_before, rms_after = (
        json.loads(run(capsys, "replay", steps, "--cell", cell, "--json")[1])["innovation_rms_v"]
        for cell in ("pem_30w", out)
    )
    assert rms_after < 0.2 * rms_before


def test_residuals_of_files_with_equal_names_are_distinguished_by_their_paths(
    capsys, steps: Path, tmp_path: Path
) -> None:
    (tmp_path / "later").mkdir()
    later = tmp_path / "later" / steps.name
    later.write_text("".join(steps.read_text().splitlines(keepends=True)[:-20]))
    out = tmp_path / "mine.toml"
    _, printed, _ = run(capsys, "identify", steps, later, "--cell", "pem_30w", "--out", out, "--json")
    result = json.loads(printed)
    assert result[f"{steps}_rms_mv"] == pytest.approx(3.0, rel=0.05)
    assert result[f"{later}_rms_mv"] == pytest.approx(3.0, rel=0.05)


def test_identify_reports_undetermined_parameters(capsys, curve: Path, tmp_path: Path) -> None:
    code, printed, _ = run(capsys, "identify", curve, "--cell", "pem_30w", "--out", tmp_path / "mine.toml")
    assert code == 0
    assert "c_dl_farad: not determined by these data; it needs steps of the current" in " ".join(printed.split())


@pytest.mark.parametrize("as_curve", [True, False])
def test_charge_positive_current_is_negated(
    capsys, curve: Path, steps: Path, tmp_path: Path, *, as_curve: bool
) -> None:
    negative = with_negated_current(curve if as_curve else steps, tmp_path)
    command = "identify", negative, "--cell", "pem_30w", "--current-sign", "charge_positive"
    code, printed, _ = run(capsys, *command, "--out", tmp_path / "mine.toml", "--json")
    assert code == 0
    assert json.loads(printed)["parameters"]["r_ohm"]["value"] == pytest.approx(AGED[1] * PEM.fuel_cell.r_ohm, rel=0.05)


@pytest.mark.parametrize("temperature_c", ["inf", "-273.15", "-127"])
def test_implausible_temperature_counts_as_missing(capsys, curve: Path, tmp_path: Path, temperature_c: str) -> None:
    lines = curve.read_text().splitlines()
    with_temperature = tmp_path / curve.name
    with_temperature.write_text(
        "\n".join([f"{lines[0]},temperature_c", *(f"{line},{temperature_c}" for line in lines[1:])])
    )
    cells = []
    for path in (curve, with_temperature):
        out = tmp_path / "mine.toml"
        code, _, _ = run(capsys, "identify", path, "--cell", "pem_30w", "--out", out, "--force")
        assert code == 0
        cells.append(load_fuel_cell(out))
    assert cells[0] == cells[1]


@pytest.mark.parametrize(
    ("temperature_c", "message"),
    [
        ("-300", "--temperature-c -300: must be between -60 and 120 °C"),
        ("121", "--temperature-c 121: must be between -60 and 120 °C"),
        ("nan", "'nan': no decimal number"),
    ],
)
def test_option_with_an_implausible_temperature_is_rejected(
    capsys, curve: Path, tmp_path: Path, temperature_c: str, message: str
) -> None:
    command = "identify", curve, "--cell", "pem_30w", "--out", tmp_path / "mine.toml"
    assert message in error(run(capsys, *command, "--temperature-c", temperature_c))


def test_replay_accepts_implausible_temperatures(capsys, tmp_path: Path) -> None:
    temperatures_c = np.array([40.0, -273.15, 40.0, 40.0])
    columns = {"time_s": np.arange(4.0), "current_a": np.full(4, 3.0), "voltage_v": np.full(4, 9.4)}
    path = write_csv(tmp_path / "cold.csv", **columns, temperature_c=temperatures_c)
    code, printed, _ = run(capsys, "replay", path, "--cell", "pem_30w", "--json")
    assert code == 0
    assert json.loads(printed)["innovation_rms_v"] < 0.2


def test_replay_learns_and_has_no_soc(capsys, steps: Path, tmp_path: Path) -> None:
    code, printed, _ = run(capsys, "replay", steps, "--cell", "pem_30w", "--json", "--out", tmp_path / "out.csv")
    assert code == 0
    result = json.loads(printed)
    assert (result["soc_initial"], result["soc_final"], result["lock_lost"]) == (None, None, False)
    assert result["samples"] == 12_000  # a minute at 200 Hz
    assert result["parameters"]["r_ohm"]["value"] > 1.1 * PEM.fuel_cell.r_ohm
    assert not result["parameters"]["concentration_v"]["valid"]
    with (tmp_path / "out.csv").open() as rows:
        last = list(csv.DictReader(rows))[-1]
    assert last["soc"] == "nan"
    assert abs(float(last["voltage_estimate_v"]) - float(last["voltage_v"])) < 0.1
    code, printed, _ = run(capsys, "replay", steps, "--cell", "pem_30w")
    assert "r_ohm" in printed
    assert "SOC" not in printed


def test_pack_file_may_name_a_fuel_cell(capsys, tmp_path: Path) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\ncell = "pem_30w"\nseries = 2\n[sensor]\nvoltage_resolution_v = 0.03\n')
    code, printed, err = run(capsys, "config", "check", pack)
    assert (code, err) == (0, "")
    assert "pem_30w, 28 in series, 18.6 V, fuel cell" in printed
    code, printed, _ = run(capsys, "config", "show", pack)
    assert code == 0
    assert "delta_1" not in printed
    assert "observer.lock_error_v" in printed


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ("series = 3", "the board's range ends at 25.0 V, but this pack has 40.1 V at no load"),
        (
            '[observer]\nlaw = "scheme-2"',
            "observer.law = 'scheme-2': ignored: a fuel cell (pem_30w) always has 'learning'",
        ),
        ("[identifier]\nenabled = true", "identifier.enabled = true: ignored: the identifier is of batteries"),
    ],
)
def test_check_warns_about_ignored_and_implausible_settings(
    capsys, tmp_path: Path, settings: str, expected: str
) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text(f'[pack]\ncell = "pem_30w"\n{settings}\n')
    code, _, err = run(capsys, "config", "check", pack)
    assert code == 0
    assert err.startswith(f"warning: {pack}: ")
    assert err.count("\n") == 1
    assert expected in err


@pytest.mark.parametrize("settings", ["", '[observer]\nlaw = "learning"', "[identifier]\nenabled = false"])
def test_check_accepts_plausible_stacks(capsys, tmp_path: Path, settings: str) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text(f'[pack]\ncell = "pem_30w"\n{settings}\n')
    assert run(capsys, "config", "check", pack)[::2] == (0, "")


def test_parallel_stacks_beyond_the_tafel_range_are_rejected(capsys, tmp_path: Path) -> None:
    pack, cell = tmp_path / "pack.toml", tmp_path / "mine.toml"
    losses = PEM.fuel_cell.model_copy(update={"exchange_current_a": 0.4})
    write_cell(cell, PEM.model_copy(update={"fuel_cell": losses}))
    pack.write_text('[pack]\ncell = "mine.toml"\nparallel = 3\n')
    code, out, err = run(capsys, "config", "check", pack)
    assert (code, out) == (2, "")
    assert err == "error: pem_30w: exchange_current_a of 3 in parallel is 1.2: must be less than 1\n"


def test_help_names_a_fuel_cell_only_for_commands_that_support_fuel_cells(capsys) -> None:
    commands = {
        c
        for c in ("capacity", "identify", "replay", "simulate", "thesis", "validate")
        if help_mentions_fuel_cell(capsys, c)
    }
    assert commands == {"identify", "replay", "simulate"}


def help_mentions_fuel_cell(capsys, command: str) -> bool:
    """Return True if the help of the command names the shipped fuel cell."""
    code, printed, _ = run(capsys, command, "--help")
    assert code == 0
    return "pem_30w" in printed


@pytest.mark.parametrize(
    "arguments",
    [
        ("capacity", "{steps}", "--cell", "pem_30w"),
        ("validate", "{steps}", "--cell", "pem_30w"),
        ("cell", "export", "{pack}", "--out", "{out}"),
        ("thesis", "{steps}", "--cell", "pem_30w"),
        ("replay", "{steps}", "--cell", "pem_30w", "--soc", "0.5"),
        ("replay", "{steps}", "--cell", "pem_30w", "--capacity-ah", "3"),
        ("replay", "{steps}", "--pack", "{pack_with_soc}"),
        ("identify", "{steps}", "--cell", "pem_30w", "--out", "{out}", "--keep-ocv"),
    ],
    ids=" ".join,
)
def test_commands_and_options_for_batteries_reject_a_fuel_cell(capsys, arguments, steps: Path, tmp_path: Path) -> None:
    pack, pack_with_soc = tmp_path / "pack.toml", tmp_path / "soc.toml"
    pack.write_text('[pack]\ncell = "pem_30w"\n')
    pack_with_soc.write_text('[pack]\ncell = "pem_30w"\ninitial_soc = 0.5\n')
    files = {"steps": steps, "pack": pack, "pack_with_soc": pack_with_soc, "out": tmp_path / "out.toml"}
    code, out, err = run(capsys, *(argument.format(**files) for argument in arguments))
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert "is a fuel cell" in err


def test_error_names_the_unusable_file(capsys, curve: Path, steps: Path, tmp_path: Path) -> None:
    short = tmp_path / "short.csv"
    short.write_text("current_a,voltage_v\n1.0,10.0\n2.0,9.0\n")
    hole = tmp_path / "hole.csv"
    hole.write_text("current_a,voltage_v\n1.0,10.0\n2.0\n3.0,8.0\n")
    one_cell = write_csv(
        tmp_path / "one_cell.csv", current_a=np.arange(4.0), voltage_v=np.array([0.86, 0.7, 0.64, 0.57])
    )
    reversed_curve, reversed_steps = (with_negated_current(path, tmp_path) for path in (curve, steps))
    for path, message in (
        (short, "2 usable points"),
        (hole, "a value is missing"),
        (tmp_path / "none.csv", "none.csv"),
        (
            one_cell,
            "only 0 usable points: at least 3 are needed within the limits of pem_30w, 2 to 18 V and up to 15 A",
        ),
        (reversed_curve, "the current is negative, but a fuel cell cannot be charged: is --current-sign right?"),
        (reversed_steps, "the current is negative, but a fuel cell cannot be charged: is --current-sign right?"),
    ):
        assert message in error(run(capsys, "identify", path, "--cell", "pem_30w", "--out", tmp_path / "out.toml"))
