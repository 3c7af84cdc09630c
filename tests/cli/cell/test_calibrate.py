"""``calibrate``: cell file from captures, and beside a simulated board, also after the program was killed."""

import asyncio
import gzip
import io
import json
import sys

import pytest

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.simulation.virtual_board import VirtualBoard
from tests.command_line import PROGRAM, run, running_program
from tests.patience import LONG_S, end

SPEED = 200.0
"""Speed of the board. At 1 Hz it sends 200 frames a second. The relay acts later by this factor times the delay of a busy
machine."""
LOAD_A = 5.0
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


class PackWithRelay:
    """Full cell whose load a relay connects."""

    def __init__(self):
        self._cell = load_cell("ncr18650")
        self._state, self._time_s, self._current_a = (1.0, 0.0, 0.0), 0.0, 0.0
        self.board = VirtualBoard(self, rate_hz=1, speed=SPEED)

    def __call__(self, time_s):
        capacity_as = 3600.0 * self._cell.cell.capacity_ah
        self._state = cell_step(self._state, self._current_a, time_s - self._time_s, capacity_as, self._cell.a)
        self._time_s, self._current_a = time_s, LOAD_A if self.board.relay_high else 0.0
        soc, v_ts, v_tl = self._state
        voltage_v = ocv(soc, *ocv_grid(self._cell)) - v_ts - v_tl - self._current_a * r_s(soc, self._cell.a)
        return Reading(self._current_a, float(voltage_v), 25.0)


def calibration(folder, *options):
    """Run ``calibrate`` beside a pack with a relay, in ``folder``."""
    command = "calibrate", "pack.toml", "--out", "cell.toml", "--relay", "high", "--relay-silent-s", "3600", *options
    return running_program(PROGRAM, *command, folder=folder)


async def read_until(process, text):
    """Read stderr until a line contains ``text``; return the lines."""
    lines = []
    async with asyncio.timeout(LONG_S):
        while not lines or text not in lines[-1]:
            lines.append((await process.stderr.readline()).decode())
            assert lines[-1], f"{text!r} is missing in:\n{''.join(lines)}"
    return lines


@pytest.fixture
async def pack(tmp_path):
    """Run the board of a full pack, whose settings file is in ``tmp_path``."""
    simulated = PackWithRelay()
    with simulated.board as board:
        (tmp_path / "pack.toml").write_text(PACK.format(port=board.path))
        running = asyncio.create_task(board.run())
        yield simulated
        await end(running)


@pytest.mark.thorough
async def test_a_killed_calibration_continues_and_writes_the_cell_file(pack, tmp_path) -> None:
    async with calibration(tmp_path) as process:
        await read_until(process, "[rest 2 of")
        process.kill()
    assert (tmp_path / "cell.calibration.json").exists()
    async with calibration(tmp_path, "--json") as process:
        lines = await read_until(process, "[discharge 3 of")
        out, err = await asyncio.wait_for(process.communicate(), LONG_S)
    assert process.returncode == 0, err.decode()
    assert "Charge the pack" not in "".join(lines)  # it did not begin again
    result = json.loads(out)
    assert (result["resistances_identified"], result["held_back"]) == (True, True)
    assert load_cell(tmp_path / "cell.toml").cell.capacity_ah == pytest.approx(3.0, rel=0.05)
    assert {path.name for path in tmp_path.glob("cell-*")} == {"cell-1.bms", "cell-2.bms", "cell-test.csv.gz"}
    assert not (tmp_path / "cell.calibration.json").exists()
    assert not pack.board.relay_high


async def test_a_signal_disconnects_the_load(pack, tmp_path) -> None:
    async with calibration(tmp_path) as process:
        await read_until(process, "[discharge ")
        async with asyncio.timeout(LONG_S):
            while not pack.board.relay_high:  # noqa: ASYNC110 - the board has no event for its relay
                await asyncio.sleep(0.01)
        process.terminate()
        _, err = await asyncio.wait_for(process.communicate(), LONG_S)
    assert (process.returncode, pack.board.relay_high) == (0, False)
    assert "the same command continues" in err.decode()


async def test_a_port_that_another_program_reads_is_an_error(pack, tmp_path) -> None:
    async with calibration(tmp_path) as first:
        await read_until(first, "[discharge ")
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
    code, _, err = run(capsys, "calibrate", pack, "--out", out)
    assert code == 2
    assert "--test long" in err
    assert "--restart" in err


def test_an_interrupted_test_of_another_pack_is_not_continued(capsys, tmp_path) -> None:
    state = '{"test": "short", "pack": "shed, 3 Ah, 1s1p", "recordings": ["cell-1.bms"]}'
    (tmp_path / "pack.toml").write_text(PACK.format(port="/dev/absent"))
    (tmp_path / "cell.calibration.json").write_text(state)
    code, _, err = run(capsys, "calibrate", tmp_path / "pack.toml", "--out", tmp_path / "cell.toml")
    assert code == 2
    assert "(shed, 3 Ah, 1s1p; now mine, 3 Ah, 1s1p); give another --out" in err
    assert (tmp_path / "cell.calibration.json").read_text() == state
