"""How far the SOC is from the truth when the service is switched on anywhere, on real captures, beside other methods.

Cell files come from `ocv` and `identify`. Each capture is entered cut in mid-load (or from its start, where the group says
so), 0.2 too low and 0.2 too high, and judged from 15 min later on, above SOC 0.05, weighted by time:

- RMSE: of the SOC against the start of the capture less Ah / capacity, or a counter of its own; mean and worst run [%]
- inside: share of time that the truth is inside soc +- 2 soc_std; mean and worst run [%]
- std: mean of soc_std [%]
- score: interval score of that band as of 95 %: its width plus 40 times what lies outside; smaller is better [%]
- NIS: of means of the innovation over ten minutes, 1 where S is right

"Its own file": there is no other capture of the cell than that which the file was made from.

Beside it, with the same cell file: a textbook EKF (two RC pairs of constant elements, 5 mV of noise), an EKF with five time
constants, resistances over SOC and temperature and the noise that suits it best, and counting from the OCV of the first sample.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import filter_settings
from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels import cell as chen_mora
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import IdentifierSettings
from bms_estimator.sources.replay import load_capture
from tests.benchmarks.baselines import FIVE_TAU_S, five_branches, fixed_ekf, ladder_ekf
from tests.estimator.anywhere.run import run_of
from tests.estimator.anywhere.score import Score, score

Floats = NDArray[np.float64]

DATA = Path(__file__).parents[3] / "shared" / "data"
PROGRAM = Path(sys.executable).with_name("bms-estimator")
WRONG = (-0.2, 0.2)
IN_MID_LOAD, FROM_START = 0.35, 0.0
"""Part of the charge before the cut."""
LOWEST_V, HIGHEST_V = 1.5, 4.5
"""What lies outside is no voltage of a cell."""
PF, NCR, LFP = "panasonic18650pf/", "ncr18650/", "a123/"


@dataclass(frozen=True)
class Recipe:
    """What a cell file is made of; a generic one of its chemistry and capacity alone."""

    capacity_ah: float
    ocv: tuple[str, ...] = ()
    identify: tuple[str, ...] = ()
    generic: str = ""


PF_ALL = Recipe(2.9, (PF + "25_hppc",), tuple(PF + f"{t}_hppc" for t in ("25", "10", "0", "n10")))
PF_25 = Recipe(2.9, PF_ALL.ocv, (PF + "25_hppc",))
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
)


@dataclass(frozen=True)
class Group:
    """Captures of one kind: name, capacity that the truth is counted with [Ah], SOC at its first sample."""

    name: str
    recipe: Recipe
    captures: tuple[tuple[str, float, float], ...]
    cut: float = IN_MID_LOAD
    gain: float = 1.0
    offset_a: float = 0.0
    capacity: float = 1.0
    """What the estimator is told over what is true."""


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
LEAF_CAPTURES = (("leaf/hppc_25c_from_full", 30.5, 1.0),)

GROUPS = (
    *(Group(f"PF {t} C", PF_ALL, captures) for t, captures in PF_CAPTURES.items()),
    *(Group(f"PF {t} C from full", PF_ALL, PF_CAPTURES[t], FROM_START) for t in ("0", "-10")),
    *(Group(f"PF {t} C, file of 25 C", PF_25, PF_CAPTURES[t]) for t in ("10", "0", "-10")),
    Group("NCR", NCR_CELL, NCR_CHANGING),
    Group("NCR, constant current", NCR_CELL, NCR_CONSTANT),
    Group("NCR, current +5 %", NCR_CELL, NCR_CHANGING, gain=1.05),
    *(Group(f"NCR, {1e3 * a:+.0f} mA", NCR_CELL, NCR_CHANGING, offset_a=a) for a in (-0.05, 0.05)),
    *(
        Group(f"NCR, capacity {100 * q:+.0f} %", NCR_CELL, NCR_CHANGING, capacity=1 + q)
        for q in (-0.05, 0.05, -0.2, 0.2)
    ),
    Group("Leaf (its own file)", LEAF, LEAF_CAPTURES),
    *(
        Group(f"LFP {t} C from full (its own file)", LFP_CELL, captures, FROM_START)
        for t, captures in LFP_CAPTURES.items()
    ),
    *(Group(f"LFP {t} C (its own file)", LFP_CELL, captures) for t, captures in LFP_CAPTURES.items()),
    Group("generic nca: PF", Recipe(2.9, generic="nca"), PF_CAPTURES["25"]),
    Group("generic nca: NCR", Recipe(3.0, generic="nca"), NCR_CHANGING),
    Group("generic lmo: Leaf", Recipe(30.5, generic="lmo"), LEAF_CAPTURES),
    Group("generic lfp: A123", Recipe(2.05, generic="lfp"), LFP_CAPTURES["25"]),
    Group("generic lfp: A123 from full", Recipe(2.05, generic="lfp"), LFP_CAPTURES["25"], FROM_START),
)


@dataclass(frozen=True)
class Outcome:
    """Of one run by each method."""

    ours: Score
    nis: float
    textbook: Score
    five: Score
    counting: Score


def main() -> None:
    """Print the table of the groups whose name contains an argument, or all."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    chosen = [g for g in GROUPS if not sys.argv[1:] or any(part in g.name for part in sys.argv[1:])]
    console = Console(width=None if sys.stdout.isatty() else 160)
    table = Table(title="switched on anywhere: RMSE/worst, inside/worst, std, score in %")
    table.add_column("group")
    for column in ("RMSE", "inside", "std", "score", "NIS", "EKF", "inside", "score", "5-tau EKF", "inside", "score"):
        table.add_column(column, justify="right")
    table.add_column("counting", justify="right")
    with tempfile.TemporaryDirectory() as folder:
        for group in chosen:
            table.add_row(group.name, *cells_of(list(outcomes(group, Path(folder)))))
    console.print(table)


def cells_of(found: list[Outcome]) -> Iterator[str]:
    """One row of the table."""
    ours = [o.ours for o in found]
    yield f"{mean([s.rmse for s in ours]):.2f}/{max(s.rmse for s in ours):.2f}"
    yield f"{mean([s.cover for s in ours]):.0f}/{min(s.cover for s in ours):.0f}"
    yield f"{mean([s.std for s in ours]):.2f}"
    yield f"{mean([s.score for s in ours]):.2f}"
    yield f"{mean([o.nis for o in found]):.2f}"
    for other in ([o.textbook for o in found], [o.five for o in found]):
        yield f"{mean([s.rmse for s in other]):.2f}"
        yield f"{mean([s.cover for s in other]):.0f}"
        yield f"{mean([s.score for s in other]):.1f}"
    yield f"{mean([o.counting.rmse for o in found]):.2f}"


def mean(values: list[float]) -> float:
    """Of some numbers."""
    return float(np.mean(values))


def outcomes(group: Group, folder: Path) -> Iterator[Outcome]:
    """Of every capture and start of a group; those that are too short are left out."""
    true_ah = group.recipe.capacity_ah
    cell = cell_file(group.recipe, folder)
    if group.capacity != 1.0:
        capacity = cell.cell.model_copy(update={"capacity_ah": group.capacity * true_ah})
        cell = cell.model_copy(update={"cell": capacity})
    for name, capacity_ah, initial_soc in group.captures:
        samples, soc = load(name, capacity_ah, initial_soc)
        drawn_ah = charge_ah(samples)
        begin = int(np.argmax(drawn_ah >= group.cut * drawn_ah[-1])) if group.cut else 0
        seen, truth = samples[begin:].copy(), soc[begin:]
        seen["current_a"] = group.gain * seen["current_a"] + group.offset_a
        for wrong in WRONG:
            outcome = compare(cell, seen, truth, float(np.clip(truth[0] + wrong, 0.0, 1.0)))
            if outcome is not None:
                yield outcome


def compare(cell: CellModel, seen: SampleBlock, truth: Floats, start_soc: float) -> Outcome | None:
    """One run by each method; None where the capture is too short."""
    run = run_of(Estimator(cell, initial_soc=start_soc), seen)
    ours = score(seen["time_s"], run.soc, run.soc_std, truth)
    if ours is None:
        return None
    grid = np.array(ocv_grid(cell))
    first = float(Estimator(cell, initial_soc=start_soc).run(seen[:1])["soc_ocv"][0])
    counted = first - charge_ah(seen) / cell.cell.capacity_ah
    others = (
        textbook(cell, seen, start_soc, grid),
        five(cell, seen, start_soc, grid),
        (counted, np.full(seen.size, np.nan)),
    )
    scores = [score(seen["time_s"], *other, truth) for other in others]
    assert None not in scores
    return Outcome(ours, run.nis(900.0), *scores)


def textbook(cell: CellModel, seen: SampleBlock, start_soc: float, grid: Floats) -> tuple[Floats, Floats]:
    """SOC and its std by the EKF with two RC pairs."""
    a = cell.a
    r_s, r1, c1, r2, c2 = (
        f(0.5, a) for f in (chen_mora.r_s, chen_mora.r_ts, chen_mora.c_ts, chen_mora.r_tl, chen_mora.c_tl)
    )
    model = np.array([3600.0 * cell.cell.capacity_ah, r_s, r1, r1 * c1, r2, r2 * c2])
    time_s, current_a, voltage_v = (np.ascontiguousarray(seen[n]) for n in ("time_s", "current_a", "voltage_v"))
    return fixed_ekf(time_s, current_a, voltage_v, start_soc, model, grid)


def five(cell: CellModel, seen: SampleBlock, start_soc: float, grid: Floats) -> tuple[Floats, Floats]:
    """The same by the EKF with five time constants."""
    p = filter_settings(cell, (grid[0], grid[1]), IdentifierSettings(), 1e-3, None)[0]
    ohm, energy_j = five_branches(p["weak_ohm"], p["strong_ohm"])
    columns = [np.ascontiguousarray(seen[n]) for n in ("time_s", "current_a", "voltage_v", "temperature_c")]
    columns[3] = np.where(np.isfinite(columns[3]), columns[3], 25.0)
    return ladder_ekf(*columns, start_soc, 3600.0 * cell.cell.capacity_ah, ohm, energy_j, FIVE_TAU_S, grid)


@cache
def cell_file(recipe: Recipe, folder: Path) -> CellModel:
    """By `ocv`, then `identify`; what they refuse to write is not used, and said."""
    if recipe.generic:
        return load_cell(recipe.generic, recipe.capacity_ah)
    stem = f"{recipe.identify[0].replace('/', '_')}_{len(recipe.identify)}"
    curve, whole = folder / f"{stem}_ocv.toml", folder / f"{stem}.toml"
    command("ocv", *map(path_of, recipe.ocv), "--capacity-ah", recipe.capacity_ah, "--out", curve)
    refused = command("identify", *map(path_of, recipe.identify), "--cell", curve, "--out", whole)
    return load_cell(curve if refused else whole)


def command(*arguments: object) -> str:
    """Run the program; why it refused, or nothing."""
    done = subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.stderr.write(f"{arguments[0]} gave no file: {done.stderr.strip().splitlines()[-1]}\n")
    return done.stderr if done.returncode else ""


def path_of(name: str) -> Path:
    """Of a capture."""
    return DATA / f"{name}.csv.gz"


@cache
def load(name: str, capacity_ah: float, initial_soc: float) -> tuple[SampleBlock, Floats]:
    """Samples without what is no voltage, and the true SOC at each."""
    rows = load_capture(path_of(name)).rows
    rows = rows[(rows["voltage_v"] > LOWEST_V) & (rows["voltage_v"] < HIGHEST_V)]
    counter = DATA / f"{name}.soc.gz"
    if counter.exists():
        time_s, soc = np.genfromtxt(counter, delimiter=",", skip_header=1).T
        return rows, np.interp(rows["time_s"], time_s, soc)
    return rows, initial_soc - charge_ah(rows) / capacity_ah


def charge_ah(samples: SampleBlock) -> Floats:
    """Drawn before each sample, shape (n,) [Ah]; the current holds until the next."""
    moved_as = samples["current_a"][:-1] * np.clip(np.diff(samples["time_s"]), 0.0, None)
    return np.concatenate([[0.0], np.cumsum(moved_as)]) / 3600.0


if __name__ == "__main__":
    main()
