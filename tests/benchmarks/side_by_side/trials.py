"""The trials: a cell, captures to learn from, and held-back captures.

Every method starts from the same cell: its file as it is at the temperature of the capture, with every resistance
twice, or half, what the file says. The capacitances stay, so every time constant is as wrong.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.calibration.elements.two_branch_fit import cell_file_sections
from bms_estimator.estimator.filter_settings import BRANCHES_STD, SOC_GRID, ladder_of_branches
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C, STRONG_J, WEAK_J, arrhenius, weak_share
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv
from bms_estimator.model.sample import SampleBlock
from tests.benchmarks.recipes import LEAF, LFP, LFP_CELL, NCR, NCR_CELL, PF, PF_PULSES, Recipe, load

WRONG_BY = (2.0, 0.5)
"""Resistances of the start over those of the cell file."""
LEFT_V = 0.02
"""Assumed voltage error of the elements [V]."""
KNOWN_K = 10.0
"""Temperature range of the start, as of a file without a ladder."""


@dataclass(frozen=True)
class Part:
    """A capture, or a part of it: SOC at the first sample of the capture, and from when until when [s of its clock]."""

    name: str
    initial_soc: float = 1.0
    begin_s: float = -np.inf
    end_s: float = np.inf


@dataclass(frozen=True)
class Trial:
    """Captures to learn from and held-back captures; all figures but the voltage use the first of these."""

    name: str
    recipe: Recipe
    learn: Part
    held_back: tuple[Part, ...]
    temperature_c: float = REFERENCE_C


@dataclass(frozen=True)
class Block:
    """Samples in the order of time, and the true SOC at each."""

    samples: SampleBlock
    soc: Floats


def _split(name: str, at_s: float) -> tuple[Part, tuple[Part, ...]]:
    """A capture before and after the end of a rest."""
    return Part(name, end_s=at_s), (Part(name, begin_s=at_s),)


TRIALS = (
    Trial("NCR 5", NCR_CELL, Part(NCR + "cell5_relaxation_c2"), (Part(NCR + "cell5_random_steps"),)),
    Trial(
        "NCR 1",
        NCR_CELL,
        Part(NCR + "cell1_hppc"),
        (
            Part(NCR + "cell1_random_steps", 0.98),
            *(Part(NCR + f"cell1_{name}") for name in ("dst", "discharge_1c5", "discharge_c4")),
        ),
    ),
    *(
        Trial(f"PF {c:g}", PF_PULSES, Part(PF + f"{t}_hppc"), tuple(Part(PF + f"{t}_{name}") for name in names), c)
        for t, c, names in (
            ("25", 25.0, ("us06", "cycle1")),
            ("10", 10.0, ("us06",)),
            ("0", 0.0, ("us06", "cycle1")),
            ("n10", -10.0, ("us06",)),
        )
    ),
    *(
        Trial(f"LFP {c:g}", LFP_CELL, *_split(LFP + f"dyn_{t}", at_s), c)
        for t, c, at_s in (("p25", 25.0, 18_745.0), ("p05", 5.0, 18_745.0), ("n15", -15.0, 25_070.0))
    ),
    Trial("Leaf", LEAF, Part("leaf/hppc_25c_from_full"), (Part("leaf/cc_1c", 0.001, 10_080.0, 13_650.0),)),
)


def block(part: Part, capacity_ah: float) -> Block:
    """Read a part of a capture."""
    rows, soc = load(part.name, capacity_ah, part.initial_soc)
    samples = remove_glitches(rows, part.name)
    inside = (samples["time_s"] >= part.begin_s) & (samples["time_s"] < part.end_s)
    samples = samples[inside]
    return Block(samples, np.interp(samples["time_s"], rows["time_s"], soc))


def chosen(parts: list[str]) -> list[Trial]:
    """Return the trials whose name contains one of ``parts``; all without parts."""
    return [trial for trial in TRIALS if not parts or any(part in trial.name for part in parts)]


def starts(right: CellModel, temperature_c: float) -> Iterator[tuple[float, CellModel]]:
    """Return the factors on the resistances, and the resulting cells."""
    for factor in WRONG_BY:
        yield factor, wrong(right, factor, temperature_c)


def at_temperature(cell: CellModel, temperature_c: float) -> CellModel:
    """The cell file as it would be if it had been made at ``temperature_c``: OCV and a1..a15."""
    update: dict[str, object] = {}
    if isinstance(cell.ocv, TableOcv) and cell.ocv.per_kelvin_v is not None:
        shifted_v = np.array(cell.ocv.ocv_v) + np.array(cell.ocv.per_kelvin_v) * (temperature_c - REFERENCE_C)
        update["ocv"] = cell.ocv.model_copy(update={"ocv_v": tuple(shifted_v.tolist()), "per_kelvin_v": None})
    if cell.ladder is not None:
        weak, strong = (arrhenius(energy_j, temperature_c) for energy_j in (WEAK_J, STRONG_J))
        ladder = cell.ladder.model_copy(
            update={
                "weak_ohm": _times(cell.ladder.weak_ohm, weak),
                "strong_ohm": _times(cell.ladder.strong_ohm, strong),
            }
        )
        update |= cell_file_sections(ladder)
    return cell.model_copy(update=update)


def wrong(cell: CellModel, factor: float, temperature_c: float) -> CellModel:
    """The cell with resistances ``factor`` times as large, and a ladder of its two branches, right at ``temperature_c``."""
    parts: dict[str, object] = {"adaptation": {}}
    for name in ("r_s", "r_ts", "r_tl"):
        part = getattr(cell, name)
        ohms = {key: factor * getattr(part, key) for key in ("amplitude_ohm", "offset_ohm")}
        parts[name] = part.model_copy(update=ohms)
    changed = cell.model_copy(update=parts)
    ohm, weak = ladder_of_branches(changed).T, weak_share(SOC_GRID)
    ladder = Ladder(
        soc=tuple(SOC_GRID.tolist()),
        weak_ohm=_rows(weak * ohm / arrhenius(WEAK_J, temperature_c)),
        strong_ohm=_rows((1.0 - weak) * ohm / arrhenius(STRONG_J, temperature_c)),
        std=BRANCHES_STD,
        error_v=LEFT_V,
        temperature_c=(temperature_c - KNOWN_K, temperature_c + KNOWN_K),
    )
    return changed.model_copy(update={"ladder": ladder})


def _rows(ohm: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, ohm.tolist()))


def _times(rows: tuple[tuple[float, ...], ...], factor: float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(factor * ohm for ohm in row) for row in rows)
