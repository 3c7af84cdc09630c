"""C header of a cell with the reference step of the documentation, compiled by gcc and avr-gcc."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.conversion.circuit import c_header, ladder_table
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import Ladder, TableOcv
from tests.conversion.load import INITIAL_SOC, difference_mv, load_profile

STEP_FOLDER = Path(__file__).parents[2] / "docs" / "cell"
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
MAX_MV = 1.0
"""Maximum difference. Its causes are single precision, and linear interpolation of the OCV with an error up to 0.2 mV."""


def compile_step(compiler: str, folder: Path, cell: CellModel, *options: str) -> Path:
    """Write the header of a cell, and compile the reference step with it. Return the file that the compiler wrote."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    header, out = folder / "cell.h", folder / "out"
    header.write_text(c_header(cell))
    command = [compiler, *options, "-Os", f'-DCELL_HEADER="{header}"', f"-I{STEP_FOLDER}", "-o", out]
    subprocess.run(command, check=True)
    return out


def step_voltages(program: Path, time_s: Floats, current_a: Floats, temperature_c: float) -> Floats:
    """Return the voltages of the compiled step [V]."""
    lines = [f"{INITIAL_SOC} {temperature_c}"]
    lines += [f"{dt_s} {a}" for dt_s, a in zip(np.diff(time_s, prepend=time_s[0]), current_a, strict=True)]
    output = subprocess.run([program], input="\n".join(lines), capture_output=True, text=True, check=True).stdout
    return np.array(output.split(), dtype=float)


def lfp() -> CellModel:
    """Return a cell with hysteresis and with a temperature coefficient."""
    cell = load_cell("lfp", 10.0)
    assert isinstance(cell.ocv, TableOcv)
    assert cell.ocv.hysteresis_v
    slope = tuple(np.linspace(-3e-4, 2e-4, len(cell.ocv.soc)))
    return cell.model_copy(update={"ocv": cell.ocv.model_copy(update={"per_kelvin_v": slope})})


def leaf_with_ladder() -> CellModel:
    """Return a cell whose file has no ladder, with the ladder that the service computes for it."""
    cell = load_cell("leaf")
    table = ladder_table(cell)
    ladder = Ladder(
        soc=table.soc.tolist(),
        weak_ohm=table.weak_ohm.tolist(),
        strong_ohm=table.strong_ohm.tolist(),
        std=0.1,
        error_v=0.01,
        temperature_c=(20.0, 30.0),
    )
    return cell.model_copy(update={"ladder": ladder})


@pytest.mark.parametrize(("cell", "temperature_c"), [(lfp(), 25.0), (lfp(), 5.0), (leaf_with_ladder(), 25.0)])
def test_the_compiled_step_predicts_the_voltage_of_the_model(tmp_path, cell, temperature_c):
    program = compile_step(
        "gcc", tmp_path, cell, "-std=c99", *STRICT, str(Path(__file__).with_name("step_main.c")), "-lm"
    )
    time_s, current_a = load_profile(cell, final_soc=0.1)
    voltage_v = step_voltages(program, time_s, current_a, temperature_c)
    assert np.abs(difference_mv(cell, time_s, current_a, voltage_v, temperature_c)).max() < MAX_MV


@pytest.mark.parametrize("name", ["leaf", "nmc"])
def test_avr_gcc_compiles_the_header_as_standard_c(tmp_path, name):
    step = str(STEP_FOLDER / "cell_step.c")
    compile_step("avr-gcc", tmp_path, load_cell(name, 5.0), "-mmcu=atmega328p", "-std=c99", "-c", *STRICT, step)


def test_the_tables_stay_in_the_flash_of_an_avr(tmp_path):
    options = ("-mmcu=atmega328p", "-std=gnu99", "-DCELL_MEMORY=__flash", "-c", "-Wall", "-Werror")
    compiled = compile_step("avr-gcc", tmp_path, load_cell("leaf"), *options, str(STEP_FOLDER / "cell_step.c"))
    sections = subprocess.run(["avr-size", "-A", compiled], capture_output=True, text=True, check=True).stdout
    assert ".progmem" in sections
    assert ".rodata" not in sections  # an AVR copies this section to RAM


def test_a_name_cannot_end_the_comment_of_the_header(tmp_path):
    cell = load_cell("leaf")
    cell = cell.model_copy(update={"cell": cell.cell.model_copy(update={"name": "a */ b-c", "description": "x\n*/y"})})
    compile_step("gcc", tmp_path, cell, "-std=c99", "-c", *STRICT, str(STEP_FOLDER / "cell_step.c"))


@pytest.mark.parametrize("name", ["*/ int evil; /*", "**// int evil; /**/", "line\nint evil;"])
def test_a_name_cannot_end_the_comment(name: str) -> None:
    cell = lfp()
    renamed = cell.model_copy(update={"cell": cell.cell.model_copy(update={"name": name, "description": name})})
    before_code = c_header(renamed).partition("#ifndef")[0]
    assert before_code.index("*/") == len(before_code) - len("*/\n")
