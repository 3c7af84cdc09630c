"""Discharge captures of the benchmark, and the cell file that the estimator has for each."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.recipes import (
    DATA,
    LEAF,
    LFP,
    LFP_CELL,
    LFP_PAIR,
    LFP_WITHOUT_5,
    NCR,
    NCR_CELL,
    PF,
    PF_25,
    PF_CYCLE,
    PF_HPPC,
    PF_PULSES,
    PF_US06,
    Recipe,
)

OWN, OTHER_TEMPERATURE, GENERIC, SIMULATED = "own file", "own file of 25 C", "generic file", "simulated, own file"
"""Kinds of cell files: of this cell at all temperatures that were measured, of this cell at 25 C, of the chemistry, and of a
simulated cell."""
DRIVE, PULSES, CONSTANT = "drive", "pulses", "constant"
"""Kinds of loads: changing from second to second or from minute to minute, pulses with long rests, constant."""
OXIDE_CUTOFF_V, PHOSPHATE_CUTOFF_V = 2.6, 2.0
"""Cut-off voltage of a cell, where the capture reaches it [V]."""
LG_CELL = Recipe(5.0, ("lgm50/rate_0p1c_25c",))
GENERIC_NCA, GENERIC_PF, GENERIC_NMC, GENERIC_LMO, GENERIC_LFP = (
    Recipe(capacity_ah, generic=name)
    for capacity_ah, name in ((3.0, "nca"), (2.9, "nca"), (5.0, "nmc"), (30.5, "lmo"), (2.05, "lfp"))
)


@dataclass(frozen=True)
class Case:
    """Capture with a cell file."""

    name: str
    """Name of the capture, without ``.csv.gz``, in ``folder``."""
    recipe: Recipe
    """Captures of the cell file, or the generic cell file."""
    file: str = OWN
    """Kind of the cell file: ``OWN``, ``OTHER_TEMPERATURE`` or ``GENERIC``."""
    load: str = DRIVE
    """Kind of the load: ``DRIVE``, ``PULSES`` or ``CONSTANT``."""
    folder: Path = DATA

    @property
    def path(self) -> Path:
        """Path of the capture."""
        return self.folder / f"{self.name}.csv.gz"

    @property
    def is_phosphate(self) -> bool:
        """True for LFP."""
        return self.recipe.generic == "lfp" or any(name.startswith(LFP) for name in self.recipe.ocv)

    @property
    def nominal_cutoff_v(self) -> float:
        """Cut-off voltage of the chemistry [V]."""
        return PHOSPHATE_CUTOFF_V if self.is_phosphate else OXIDE_CUTOFF_V


PF_COLD_DRIVES = ("10_us06", "0_us06", "0_cycle1", "n10_us06")
CASES = (
    Case(PF + "25_us06", PF_CYCLE),
    *(Case(PF + name, PF_US06) for name in ("25_cycle1", *PF_COLD_DRIVES)),
    *(Case(NCR + name, NCR_CELL) for name in ("cell1_random_steps", "cell5_random_steps", "cell1_dst")),
    Case(LFP + "dyn_p05", LFP_WITHOUT_5),
    *(Case(LFP + name, LFP_CELL) for name in ("dyn_p25", "dyn_n15")),
    *(Case(name, PF_PULSES, load=PULSES) for name in PF_HPPC),
    *(Case(NCR + name, NCR_CELL, load=PULSES) for name in ("cell1_hppc", "cell5_hppc", "cell5_relaxation_c2")),
    Case("leaf/hppc_25c_from_full", LEAF, load=PULSES),
    *(Case(NCR + f"cell1_discharge_{rate}", NCR_CELL, load=CONSTANT) for rate in ("c20", "c4", "1c5")),
    *(Case(f"lgm50/rate_{rate}_25c", LG_CELL, load=CONSTANT) for rate in ("0p1c", "0p5c", "1c")),
    Case("leaf/cc_1c", LEAF, load=CONSTANT),
    *(Case(PF + name, PF_25, OTHER_TEMPERATURE) for name in PF_COLD_DRIVES),
    *(Case(LFP + name, LFP_PAIR, OTHER_TEMPERATURE) for name in ("dyn_p05", "dyn_n15")),
    *(Case(PF + name, GENERIC_PF, GENERIC) for name in ("25_us06", "25_cycle1", *PF_COLD_DRIVES)),
    *(Case(NCR + name, GENERIC_NCA, GENERIC) for name in ("cell1_random_steps", "cell5_random_steps", "cell1_dst")),
    *(Case(LFP + name, GENERIC_LFP, GENERIC) for name in ("dyn_p25", "dyn_p05", "dyn_n15")),
    *(Case(f"lgm50/rate_{rate}_25c", GENERIC_NMC, GENERIC, CONSTANT) for rate in ("0p5c", "1c")),
    Case("leaf/cc_1c", GENERIC_LMO, GENERIC, CONSTANT),
)
"""Cases of the captures in ``DATA``. A cell file is not computed from the drive that it is judged by, except for LFP at 25 C
and -15 C, of which there is no other capture, and for ``PULSES``."""
FILE_OF_FOLDER = {
    "panasonic18650pf": PF_US06,
    "ncr18650": NCR_CELL,
    "a123": LFP_CELL,
    "lgm50": LG_CELL,
    "leaf": LEAF,
}
"""Cell file of the captures in another folder of data, by the name of the cell's folder."""


def cases(words: list[str]) -> list[Case]:
    """Return the cases whose name or kind of file contains one of ``words``, or all cases if there are no words."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    return [case for case in CASES if not words or any(word in f"{case.name} {case.file}" for word in words)]


def other_cases(data: Path, words: list[str], recipe: Recipe | None) -> Iterator[Case]:
    """Yield a case for each capture in another folder, ``data/cell/capture.csv.gz``, whose name contains one of ``words``.

    Args:
        data: Folder of the captures.
        words: Parts of names; without words all captures are chosen.
        recipe: Cell file of the captures; None: that of the folder's name. Exit if there is no file of this name.
    """
    for path in sorted(data.rglob("*.csv.gz")):
        name = str(path.relative_to(data)).removesuffix(".csv.gz")
        if words and not any(word in name for word in words):
            continue
        of_cell = recipe or FILE_OF_FOLDER.get(path.parent.name)
        if of_cell is None:
            known = ", ".join(FILE_OF_FOLDER)
            sys.exit(f"{path}: no cell file for the folder {path.parent.name} (known: {known}); give one with --cell")
        yield Case(name, of_cell, folder=data)
