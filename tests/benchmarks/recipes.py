"""Groups of real captures, and their cell files by this project's commands."""

import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.sources.captures.replay import load_capture

DATA = Path(__file__).parents[3] / "shared" / "data"
PROGRAM = Path(sys.executable).with_name("bms-estimator")
SOC_ERRORS = (-0.2, 0.2)
"""Errors of the initial SOC; each run is done with both."""
IN_MID_LOAD, FROM_START = 0.35, 0.0
"""Fractions of the charge of a capture that have flowed when the estimator starts."""
LOWEST_V, HIGHEST_V = 1.5, 4.5
"""Range of valid cell voltages [V]."""
PF, NCR, LFP = "panasonic18650pf/", "ncr18650/", "a123/"
"""Folders of the captures of the Panasonic 18650PF, NCR18650 and A123 cells."""


@dataclass(frozen=True)
class Recipe:
    """Captures from which the commands `ocv` and `identify` compute a cell file, or the name of a generic cell file."""

    capacity_ah: float
    ocv: tuple[str, ...] = ()
    identify: tuple[str, ...] = ()
    generic: str = ""
    measures_capacity: bool = False
    """True if `ocv` measures the capacity, so that it is not declared."""


# cell files of the Panasonic cell, by the captures for `identify`
PF_HPPC = tuple(PF + f"{t}_hppc" for t in ("25", "10", "0", "n10"))
PF_PULSES = Recipe(2.9, PF_HPPC[:1], PF_HPPC)
PF_US06 = Recipe(2.9, PF_HPPC[:1], (*PF_HPPC, PF + "25_us06"))
PF_CYCLE = Recipe(2.9, PF_HPPC[:1], (*PF_HPPC, PF + "25_cycle1"))
PF_25 = Recipe(2.9, PF_HPPC[:1], (PF_HPPC[0], PF + "25_us06"))
NCR_CELL = Recipe(
    3.0,
    tuple(NCR + name for name in ("cell1_discharge_c20", "cell1_charge_c20", "cell5_relaxation_c2")),
    (NCR + "cell5_relaxation_c2", NCR + "cell5_hppc"),
)
LEAF = Recipe(30.5, ("leaf/hppc_25c_from_full",), ("leaf/hppc_25c_from_full",))
LFP_CELL = Recipe(
    2.05,
    tuple(LFP + f"c30_{way}_{t}" for way in ("dis", "chg") for t in ("p25", "p05", "n15")),
    tuple(LFP + f"dyn_{t}" for t in ("p25", "p05", "n15")),
    measures_capacity=True,
)
LFP_PAIR = replace(LFP_CELL, ocv=(LFP + "c30_dis_p25", LFP + "c30_chg_p25"), identify=())
LFP_WITHOUT_5 = replace(LFP_CELL, identify=(LFP + "dyn_p25", LFP + "dyn_n15"))


@dataclass(frozen=True)
class Group:
    """Captures of one kind, with one cell file."""

    name: str
    recipe: Recipe
    captures: tuple[tuple[str, float, float], ...]
    """Name, capacity for the true SOC [Ah] and SOC at the first sample of each capture."""
    cut: float = IN_MID_LOAD
    """Fraction of the charge that has flowed when the estimator starts."""
    gain: float = 1.0
    """Gain error of the current sensor: measured divided by true current."""
    offset_a: float = 0.0
    """Offset of the current sensor [A]."""
    capacity_ratio: float = 1.0
    """Capacity in the cell file divided by the true capacity."""
    charging: bool = False
    """True: the estimator starts in the charge after the lowest SOC, and ``cut`` is a fraction of that charge."""


NCR_CHANGING = (
    (NCR + "cell1_random_steps", 3.0, 0.98),
    (NCR + "cell1_dst", 3.0, 1.0),
    (NCR + "cell5_random_steps", 3.0, 1.0),
    (NCR + "cell1_hppc", 3.0, 1.0),
)
NCR_CONSTANT = ((NCR + "cell1_discharge_c4", 3.0, 1.0), (NCR + "cell1_discharge_1c5", 3.0, 1.0))
PF_CAPTURES = {
    t: tuple((PF + name, 2.9, 1.0) for name in names)
    for t, names in {
        "25": ("25_us06", "25_cycle1"),
        "10": ("10_us06",),
        "0": ("0_us06", "0_cycle1"),
        "-10": ("n10_us06",),
    }.items()
}
LFP_CAPTURES = {t: ((LFP + name, 2.05, 1.0),) for t, name in (("25", "dyn_p25"), ("5", "dyn_p05"), ("-15", "dyn_n15"))}
LFP_FILES = (
    ("25", " (its own file)", LFP_CELL),
    ("5", "", LFP_WITHOUT_5),
    ("-15", " (its own file)", LFP_CELL),
)
"""Temperature [C], note in the name, and recipe of each LFP group. The cell file for the capture at 5 C is computed without
this capture."""
LFP_CHARGES = {
    t: ((LFP + name, 2.05, soc),)
    for t, name, soc in (("25", "c30_chg_p25", -0.006), ("5", "c30_chg_p05", 0.011), ("-15", "c30_chg_n15", 0.061))
}
NCR_CHARGE = ((NCR + "cell1_charge_c20", 3.064, 0.0),)
"""Charge from empty to full."""
LG_CHARGES = (("lgm50/rate_0p1c_25c", 4.945, 1.0), ("lgm50/rate_1c_25c", 4.945, 1.0))
"""Captures of a discharge followed by a charge at C/3."""
LG_DISCHARGES = (("lgm50/rate_0p5c_25c", 4.945, 1.0), ("lgm50/rate_1c_25c", 4.945, 1.0))
LEAF_CAPTURES = (("leaf/hppc_25c_from_full", 30.5, 1.0),)

GROUPS = (
    Group("PF 25 C, US06", PF_CYCLE, PF_CAPTURES["25"][:1]),
    Group("PF 25 C, mixed cycle", PF_US06, PF_CAPTURES["25"][1:]),
    *(Group(f"PF {t} C", PF_US06, PF_CAPTURES[t]) for t in ("10", "0", "-10")),
    *(Group(f"PF {t} C from full", PF_US06, PF_CAPTURES[t], FROM_START) for t in ("0", "-10")),
    *(Group(f"PF {t} C, file of pulses", PF_PULSES, captures) for t, captures in PF_CAPTURES.items()),
    *(Group(f"PF {t} C, file of 25 C", PF_25, PF_CAPTURES[t]) for t in ("10", "0", "-10")),
    Group("NCR", NCR_CELL, NCR_CHANGING),
    Group("NCR, constant current", NCR_CELL, NCR_CONSTANT),
    Group("NCR, current +5 %", NCR_CELL, NCR_CHANGING, gain=1.05),
    *(Group(f"NCR, {1e3 * a:+.0f} mA", NCR_CELL, NCR_CHANGING, offset_a=a) for a in (-0.05, 0.05)),
    *(
        Group(f"NCR, capacity {100 * q:+.0f} %", NCR_CELL, NCR_CHANGING, capacity_ratio=1 + q)
        for q in (-0.05, 0.05, -0.2, 0.2)
    ),
    Group("Leaf (its own file)", LEAF, LEAF_CAPTURES),
    *(Group(f"LFP {t} C from full{own}", recipe, LFP_CAPTURES[t], FROM_START) for t, own, recipe in LFP_FILES),
    *(Group(f"LFP {t} C{own}", recipe, LFP_CAPTURES[t]) for t, own, recipe in LFP_FILES),
    *(Group(f"PF {t} C, by ocv alone", Recipe(2.9, PF_HPPC[:1]), captures) for t, captures in PF_CAPTURES.items()),
    Group("NCR, by ocv alone", replace(NCR_CELL, identify=()), NCR_CHANGING),
    Group("LG M50, by ocv alone", Recipe(5.0, ("lgm50/rate_0p1c_25c",)), LG_DISCHARGES),
    *(Group(f"LFP {t} C, by ocv alone", LFP_PAIR, captures) for t, captures in LFP_CAPTURES.items()),
    Group("NCR, charging (its own file)", NCR_CELL, NCR_CHARGE, charging=True),
    *(
        Group(f"LFP {t} C, charging (its own file)", LFP_CELL, charges, charging=True)
        for t, charges in LFP_CHARGES.items()
    ),
    Group("LG M50, charging, by ocv alone", Recipe(5.0, ("lgm50/rate_0p1c_25c",)), LG_CHARGES, charging=True),
    Group(
        "LFP 25 C, charging, by ocv of a discharge",
        replace(LFP_PAIR, ocv=LFP_PAIR.ocv[:1]),
        LFP_CHARGES["25"],
        charging=True,
    ),
    Group("generic nca: PF", Recipe(2.9, generic="nca"), PF_CAPTURES["25"]),
    *(Group(f"generic nca: PF {t} C", Recipe(2.9, generic="nca"), PF_CAPTURES[t]) for t in ("10", "0", "-10")),
    Group("generic nca: NCR", Recipe(3.0, generic="nca"), NCR_CHANGING),
    Group("generic lmo: Leaf", Recipe(30.5, generic="lmo"), LEAF_CAPTURES),
    Group("generic lfp: A123", Recipe(2.05, generic="lfp"), LFP_CAPTURES["25"]),
    *(Group(f"generic lfp: A123 {t} C", Recipe(2.05, generic="lfp"), LFP_CAPTURES[t]) for t in ("5", "-15")),
    Group("generic lfp: A123 from full", Recipe(2.05, generic="lfp"), LFP_CAPTURES["25"], FROM_START),
    Group("generic nmc: LG M50, charging", Recipe(5.0, generic="nmc"), LG_CHARGES, charging=True),
    Group("generic nca: NCR, charging", Recipe(3.0, generic="nca"), NCR_CHARGE, charging=True),
    Group("generic lfp: A123, charging", Recipe(2.05, generic="lfp"), LFP_CHARGES["25"], charging=True),
)


def chosen(groups: Iterable[Group], parts: list[str]) -> list[Group]:
    """Return the groups whose name contains one of ``parts``, or all groups if there are no parts."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    return [g for g in groups if not parts or any(part in g.name for part in parts)]


def runs(group: Group, folder: Path) -> Iterator[tuple[CellModel, SampleBlock, Floats, float]]:
    """Yield cell file, samples, true SOC and (wrong) initial SOC of each run: each capture with each of ``SOC_ERRORS``."""
    true_ah = group.recipe.capacity_ah
    cell = cell_file(group.recipe, folder)
    if group.capacity_ratio != 1.0:
        declared = cell.cell.model_copy(update={"capacity_ah": group.capacity_ratio * true_ah})
        cell = cell.model_copy(update={"cell": declared})
    for name, capacity_ah, initial_soc in group.captures:
        samples, soc = load(name, capacity_ah, initial_soc)
        begin = first_sample(samples, group)
        measured, true_soc = samples[begin:].copy(), soc[begin:]
        measured["current_a"] = group.gain * measured["current_a"] + group.offset_a
        for soc_error in SOC_ERRORS:
            yield cell, measured, true_soc, float(np.clip(true_soc[0] + soc_error, 0.0, 1.0))


def first_sample(samples: SampleBlock, group: Group) -> int:
    """Return the index of the sample at which the estimator starts, by ``cut`` and ``charging`` of the group."""
    discharged_ah = charge_ah(samples)
    lowest = int(np.argmax(discharged_ah)) if group.charging else 0
    moved_ah = np.abs(discharged_ah[lowest:] - discharged_ah[lowest])
    return lowest + int(np.argmax(moved_ah >= group.cut * moved_ah[-1]))


@cache
def cell_file(recipe: Recipe, folder: Path) -> CellModel:
    """Return the cell file by `ocv` and `identify`. If `identify` fails, print its error and return the file by `ocv`."""
    if recipe.generic:
        return load_cell(recipe.generic, recipe.capacity_ah)
    captures = *recipe.ocv, *recipe.identify
    stem = f"{captures[0].replace('/', '_')}_{len(captures)}_{captures[-1].replace('/', '_')}"
    ocv_file, identified_file = folder / f"{stem}_ocv.toml", folder / f"{stem}.toml"
    capacity_option = () if recipe.measures_capacity else ("--capacity-ah", recipe.capacity_ah)
    run_command("ocv", *map(path_of, recipe.ocv), *capacity_option, "--out", ocv_file)
    if not recipe.identify:
        return load_cell(ocv_file)
    identify_error = run_command(
        "identify", *map(path_of, recipe.identify), "--cell", ocv_file, "--out", identified_file
    )
    return load_cell(ocv_file if identify_error else identified_file)


def run_command(*arguments: object) -> str:
    """Run the program; return its error text, empty if it succeeded."""
    process = subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True, check=False)
    if process.returncode:
        sys.stderr.write(f"{arguments[0]} gave no file: {process.stderr.strip().splitlines()[-1]}\n")
    return process.stderr if process.returncode else ""


def path_of(name: str) -> Path:
    """Return the path of a capture."""
    return DATA / f"{name}.csv.gz"


@cache
def load(name: str, capacity_ah: float, initial_soc: float) -> tuple[SampleBlock, Floats]:
    """Return samples without invalid voltages, and the true SOC at each."""
    rows = load_capture(path_of(name)).rows
    rows = rows[(rows["voltage_v"] > LOWEST_V) & (rows["voltage_v"] < HIGHEST_V)]
    counter_file = DATA / f"{name}.soc.gz"  # true SOC by the charge counter of the tester
    if counter_file.exists():
        time_s, soc = np.genfromtxt(counter_file, delimiter=",", skip_header=1).T
        return rows, np.interp(rows["time_s"], time_s, soc)
    return rows, initial_soc - charge_ah(rows) / capacity_ah


def charge_ah(samples: SampleBlock) -> Floats:
    """Return the charge discharged before each sample [Ah], shape (n,). The current is constant between samples."""
    charge_as = samples["current_a"][:-1] * np.clip(np.diff(samples["time_s"]), 0.0, None)
    return np.concatenate([[0.0], np.cumsum(charge_as)]) / 3600.0
