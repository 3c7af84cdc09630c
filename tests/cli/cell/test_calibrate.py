"""``calibrate``: cell file from captures, and beside a simulated board, also after the program was killed."""

import asyncio
import contextlib
import gzip
import io
import itertools
import json
import math
import signal
import sys

import numpy as np
import pytest

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each
from bms_estimator.model.arrays import capture_digest
from bms_estimator.model.cell import load_cell
from bms_estimator.process.runtime import end_tasks
from bms_estimator.simulation.simulated_pack import PackWithRelay
from bms_estimator.simulation.virtual_board import VirtualBoard
from bms_estimator.sources.captures.raw_capture import CaptureWriter, read_capture, read_header
from bms_estimator.sources.captures.replay import load_capture
from tests.command_line import PROGRAM, error, run, running_program
from tests.patience import LONG_S

LOAD_A = 3.0
SLICE_S = 10.0
"""Time that the board simulates before it waits until the program has recorded its samples [s]."""
STALL_S = 0.25
"""Time after which the board stops waiting [s], because the program does not run yet, or has not opened the port."""
KILL_DELAY_S = 100.0
"""Time from the beginning of a discharge or rest to the kill [s]."""
PACK = """
[pack]
name = "mine"
cell = "nca"
capacity_ah = 3.0
full_voltage_v = 4.16

[sensor]
port = "{port}"
sample_rate_hz = 1
"""


def _text_of(path):
    return gzip.decompress(path.read_bytes()).decode()


class MeasuredPack:
    """Full cell with a load, and the board that measures it and connects the load.

    The board waits for the program after each slice, so that the relay acts within a few slices on a busy machine, too.
    """

    def __init__(self, folder):
        self.cell = load_cell("ncr18650")
        self._folder = folder
        self.is_loaded, self.discharges, self._switched_s = False, 0, 0.0
        self.board = VirtualBoard(self, rate_hz=1, speed=math.inf)
        self.charge()

    def __call__(self, time_s):
        reading = self._pack(time_s)
        if self.is_loaded != self.board.relay_high:
            self.is_loaded, self._switched_s = self.board.relay_high, time_s
            self.discharges += self.is_loaded
        return reading

    def charge(self):
        """Make the cell full and settled."""
        self._pack = PackWithRelay(self.cell, LOAD_A, soc=1.0)
        self._pack.is_connected = lambda: self.board.relay_high

    def is_within(self, phase, number):
        """Return True from ``KILL_DELAY_S`` after the beginning of a discharge, or of the rest after it."""
        is_phase = self.is_loaded == (phase == "discharge") and self.discharges == number
        return is_phase and self._pack.time_s - self._switched_s >= KILL_DELAY_S

    async def advance(self, until=lambda: False):
        """Advance until a condition holds. The samples before the last slice are then in the program's recording.

        This never returns if no program reads the line any more.
        """
        while not until():
            recorded = self._recorded_bytes()
            await self.board.run(SLICE_S)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(STALL_S):
                    while self._recorded_bytes() == recorded:  # noqa: ASYNC110 - a file has no event
                        await asyncio.sleep(0.001)

    @contextlib.asynccontextmanager
    async def advancing(self):
        """Advance in the background, also after the end of the program."""
        task = asyncio.create_task(self.advance())
        try:
            yield
        finally:
            await end_tasks(task)

    def _recorded_bytes(self):
        return sum(path.stat().st_size for path in self._folder.glob("*.bms"))


def move_to_the_past(recording, seconds):
    """Change the arrival times of a recording, as if its program had been killed ``seconds`` earlier."""
    header, batches = read_header(recording), list(read_capture(recording))
    recording.unlink()
    with CaptureWriter(recording, header) as writer:
        for arrival_s, data in itertools.chain.from_iterable(batches):
            writer.write(arrival_s - seconds, data)


def ocv_at(cell, drawn_ah):
    """Return the OCV after charges were drawn from a full cell [V]."""
    return ocv_of_each(1.0 - drawn_ah / cell.cell.capacity_ah, *ocv_grid(cell))


def calibration(folder, *options):
    """Run ``calibrate`` beside a pack with a relay, in ``folder``."""
    command = "calibrate", "pack.toml", "--out", "cell.toml", "--relay", "high", "--relay-silent-s", "3600", *options
    return running_program(PROGRAM, *command, folder=folder)


@pytest.fixture
def pack(tmp_path):
    """Return a full pack, whose settings file is in ``tmp_path``."""
    simulated = MeasuredPack(tmp_path)
    with simulated.board as board:
        (tmp_path / "pack.toml").write_text(PACK.format(port=board.path))
        yield simulated


@pytest.mark.parametrize(
    ("phase", "hours", "begins_again"),
    [
        ("rest", 1.0, False),
        pytest.param("discharge", 0.0, False, marks=pytest.mark.thorough),
        pytest.param("discharge", 1.0, True, marks=pytest.mark.thorough),
    ],
)
async def test_after_a_kill_the_test_continues_unless_charge_may_be_missing(
    pack, tmp_path, phase, hours, begins_again
) -> None:
    async with calibration(tmp_path) as process:
        await pack.advance(until=lambda: pack.is_within(phase, 3))
        process.kill()
    assert json.loads((tmp_path / "cell.calibration.json").read_text())["recordings"] == ["cell-1.bms"]
    move_to_the_past(tmp_path / "cell-1.bms", 3600.0 * hours)
    pack.board.reset()  # as by the next opening of the port; the relay disconnects the load
    if begins_again:
        pack.charge()
    async with calibration(tmp_path, "--json") as process, pack.advancing():
        out, err = await asyncio.wait_for(process.communicate(), LONG_S)
    assert process.returncode == 0, err.decode()
    result = json.loads(out)
    assert (result["resistances_identified"], result["held_back"]) == (True, True)
    assert {path.name for path in tmp_path.glob("cell-*")} == {"cell-1.bms", "cell-2.bms", "cell-test.csv.gz"}
    assert not (tmp_path / "cell.calibration.json").exists()
    assert not pack.board.relay_high
    fit = load_cell(tmp_path / "cell.toml").fit
    assert fit is not None
    assert fit.captures == (capture_digest(load_capture(tmp_path / "cell-test.csv.gz").rows),)
    capture_begin_s = float(_text_of(tmp_path / "cell-test.csv.gz").splitlines()[1].partition(",")[0])
    assert (capture_begin_s > 3600.0) == begins_again
    drawn_ah = np.linspace(0.0, 2.6, 100)
    assert ocv_at(load_cell(tmp_path / "cell.toml"), drawn_ah) == pytest.approx(ocv_at(pack.cell, drawn_ah), abs=0.03)


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.thorough), signal.SIGTERM])
async def test_a_signal_disconnects_the_load_and_ends_with_code_130(pack, tmp_path, number) -> None:
    async with calibration(tmp_path) as process:
        await pack.advance(until=lambda: pack.is_loaded)
        process.send_signal(number)
        async with pack.advancing():
            _, err = await asyncio.wait_for(process.communicate(), LONG_S)
    assert (process.returncode, pack.board.relay_high) == (130, False)
    assert "the same command continues" in err.decode()


@pytest.mark.thorough
async def test_a_port_that_another_program_reads_is_an_error(pack, tmp_path) -> None:
    async with calibration(tmp_path):
        await pack.advance(until=lambda: pack.is_loaded)
        async with calibration(tmp_path, "--out", "other.toml") as second:
            _, err = await asyncio.wait_for(second.communicate(), LONG_S)
    assert second.returncode == 2
    assert f"{pack.board.path}: in use by " in err.decode()
    assert "end that program first" in err.decode()
    assert not list(tmp_path.glob("other*"))


def test_one_capture_of_a_leaf_cell_gives_a_cell_file_with_a_verdict(capsys, data, tmp_path) -> None:
    out = tmp_path / "leaf.toml"
    capture = data / "leaf" / "hppc_25c_from_full.csv.gz"
    code, printed, err = run(capsys, "calibrate", capture, "--cell", "lmo", "--capacity", 30, "--out", out, "--json")
    assert code == 0, err
    result = json.loads(printed)
    assert result["captures"][0]["gives_ocv"]
    assert result["resistances_identified"]
    assert result["verdict"].startswith("The model predicts the voltage within ")
    assert load_cell(out).cell.capacity_ah == pytest.approx(30.465, abs=0.01)
    assert "Validated on the last 30 %" in out.read_text()


@pytest.mark.thorough
def test_a_capture_of_a_pack_from_standard_input_is_scaled_to_one_cell(capsys, monkeypatch, data, tmp_path) -> None:
    rows = [line.split(",") for line in _text_of(data / "lgm50" / "rate_0p1c_25c.csv.gz").splitlines()]
    voltage = rows[0].index("voltage_v")
    for row in rows[1:]:
        row[voltage] = f"{2.0 * float(row[voltage]):.5f}"
    text = "\n".join(",".join(row) for row in rows) + "\n"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text.replace("current_a", "load", 1).encode())))
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\ncell = "nmc"\ncapacity_ah = 5.0\nseries = 2\n')
    out = tmp_path / "cell.toml"
    column_map, report = "time=time_s,current=load,voltage=voltage_v", tmp_path / "report.html"
    arguments = "--map", column_map, "--out", out, "--report", report, "--json"
    code, _, err = run(capsys, "calibrate", pack, "-", *arguments)
    assert code == 0, err
    cell = load_cell(out).cell
    assert (cell.series_count, cell.capacity_ah) == (1, pytest.approx(4.945, abs=0.01))
    assert cell.nominal_voltage_v < 4.0
    assert err.count("stdin: read as given columns") == 1
    assert report.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("{capture}",), "give --cell NAME and --capacity AH"),
        (("{capture}", "--cell", "lmo"), "give its capacity"),
        (("{pack}", "--out", "{pack}", "--force"), "is also an input"),
        (
            ("{pack}", "--relay-command", "/no/such", "--out", "{missing}"),
            "--relay-command /no/such: no such program here",
        ),
        (("{missing}", "--cell", "lmo", "--capacity", "30"), "no such file"),
    ],
)
def test_wrong_arguments_are_errors_with_a_remedy(capsys, data, tmp_path, arguments, message) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text('[pack]\ncell = "lmo"\ncapacity_ah = 30.0\n')
    paths = {"capture": data / "leaf" / "cc_1c.csv.gz", "pack": pack, "missing": tmp_path / "missing.csv"}
    code, _, err = run(capsys, "calibrate", *(each.format(**paths) for each in arguments))
    assert (code, message in err) == (2, True), err


def test_an_interrupted_test_is_not_replaced_by_another(capsys, tmp_path) -> None:
    pack, out = tmp_path / "pack.toml", tmp_path / "cell.toml"
    pack.write_text(PACK.format(port="/dev/null"))
    (tmp_path / "cell.calibration.json").write_text('{"test": "long", "recordings": []}')
    err = error(run(capsys, "calibrate", pack, "--out", out))
    assert "--test long" in err
    assert "--restart" in err


def test_an_interrupted_test_of_another_pack_is_not_continued(capsys, tmp_path) -> None:
    state = '{"test": "short", "pack": "shed, 3 Ah, 1s1p", "recordings": ["cell-1.bms"]}'
    (tmp_path / "pack.toml").write_text(PACK.format(port="/dev/absent"))
    (tmp_path / "cell.calibration.json").write_text(state)
    err = error(run(capsys, "calibrate", tmp_path / "pack.toml", "--out", tmp_path / "cell.toml"))
    assert "(shed, 3 Ah, 1s1p; now mine, 3 Ah, 1s1p); give another --out" in err
    assert (tmp_path / "cell.calibration.json").read_text() == state


@pytest.mark.usefixtures("empty_plots")
def test_series_and_temperature_reach_fit_validation_and_report(capsys, data, tmp_path) -> None:
    rows = [line.split(",") for line in _text_of(data / "lgm50" / "rate_0p1c_25c.csv.gz").splitlines()]
    voltage = rows[0].index("voltage_v")
    kept = [index for index, name in enumerate(rows[0]) if name in ("time_s", "current_a", "voltage_v")]
    for row in rows[1:]:
        row[voltage] = f"{2.0 * float(row[voltage]):.5f}"
    path = tmp_path / "two.csv"
    path.write_text("".join(",".join(row[index] for index in kept) + "\n" for row in rows))
    out, report = tmp_path / "cell.toml", tmp_path / "report.html"
    options = "--cell", "nmc", "--capacity", 5, "--series", 2, "--temperature-c", 10
    code, printed, err = run(capsys, "calibrate", path, *options, "--out", out, "--report", report, "--json")
    assert code == 0, err
    result = json.loads(printed)
    assert result["captures"][0]["temperature_c"] == 10.0
    assert "temperatures other than 10 °C" in result["verdict"]
    assert "temperatures other than 10 °C" in report.read_text(encoding="utf-8")


@pytest.mark.thorough
def test_the_soc_at_the_start_of_a_partial_discharge_is_asked_for_and_reaches_fit_and_report(capsys, tmp_path) -> None:
    cell, begin_soc = load_cell("nmc", 40.0), 0.8
    current_a = np.r_[np.zeros(30), np.full(round(begin_soc * 9.0 * 60.0), 40.0 / 9.0), np.zeros(30)]
    soc = begin_soc - np.r_[0.0, np.cumsum(current_a[:-1])] / 60.0 / 40.0
    voltage_v = ocv_of_each(np.clip(soc, 0.0, 1.0), *ocv_grid(cell)) - 1e-3 * current_a
    path, out, report = tmp_path / "partial.csv", tmp_path / "cell.toml", tmp_path / "page.html"
    rows = [f"{60 * i},{a:.4f},{v:.4f}\n" for i, (a, v) in enumerate(zip(current_a, voltage_v, strict=True))]
    path.write_text("time_s,current_a,voltage_v\n" + "".join(rows))
    options = "--cell", "nmc", "--capacity", 43, "--out", out, "--json"
    _, printed, err = run(capsys, "calibrate", path, *options)
    assert "nothing proves that it starts with a full cell" in err
    assert "give --soc" in err
    result = json.loads(printed)
    assert not result["ocv_measured"]
    assert result["capacity_origin"].startswith("rated")
    options = *options, "--force", "--soc", begin_soc, "--report", report
    code, printed, err = run(capsys, "calibrate", path, *options)
    assert code == 0, err
    result = json.loads(printed)
    assert result["capacity_ah"] == pytest.approx(40.0, rel=0.01)
    assert result["capacity_origin"] == "measured by a slow discharge from the given SOC of 0.8 to empty"
    assert "nothing proves" not in err
    assert report.exists()
