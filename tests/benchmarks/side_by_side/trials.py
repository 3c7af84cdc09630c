"""Trials of the comparison. Each has a cell, a capture to learn from, and held-back captures.

Every method starts from the same two cells: the cell file at the temperature of the capture, with every resistance doubled,
and with every resistance halved. Capacitances are correct, so that time constants are wrong by the same factor.
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

START_FACTORS = (2.0, 0.5)
"""Factors by which the resistances of the two start cells differ from the cell file."""
ELEMENT_ERROR_V = 0.02
"""Voltage error of the elements that the start cells declare [V]."""
TEMPERATURE_RANGE_K = 10.0
"""Distance of the temperature limits of a start cell from the temperature of its trial [K]."""


@dataclass(frozen=True)
class CapturePart:
    """Capture, or a part of it."""

    name: str
    initial_soc: float = 1.0
    """SOC at the first sample of the whole capture."""
    begin_s: float = -np.inf
    """Begin of the part, by the clock of the capture [s]."""
    end_s: float = np.inf
    """End of the part, by the clock of the capture [s]."""


@dataclass(frozen=True)
class Trial:
    """Capture to learn from, and held-back captures. All figures except the voltage use only the first held-back capture."""

    name: str
    recipe: Recipe
    learn: CapturePart
    held_back: tuple[CapturePart, ...]
    temperature_c: float = REFERENCE_C


@dataclass(frozen=True)
class Block:
    """Samples in the order of time, and the true SOC at each sample."""

    samples: SampleBlock
    soc: Floats


def _split(name: str, at_s: float) -> tuple[CapturePart, tuple[CapturePart, ...]]:
    """Return a capture before ``at_s`` to learn from, and after it to evaluate on. A rest ends at ``at_s`` [s]."""
    return CapturePart(name, end_s=at_s), (CapturePart(name, begin_s=at_s),)


TRIALS = (
    Trial("NCR 5", NCR_CELL, CapturePart(NCR + "cell5_relaxation_c2"), (CapturePart(NCR + "cell5_random_steps"),)),
    Trial(
        "NCR 1",
        NCR_CELL,
        CapturePart(NCR + "cell1_hppc"),
        (
            CapturePart(NCR + "cell1_random_steps", 0.98),
            *(CapturePart(NCR + f"cell1_{name}") for name in ("dst", "discharge_1c5", "discharge_c4")),
        ),
    ),
    *(
        Trial(
            f"PF {c:g}",
            PF_PULSES,
            CapturePart(PF + f"{t}_hppc"),
            tuple(CapturePart(PF + f"{t}_{name}") for name in names),
            c,
        )
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
    Trial(
        "Leaf", LEAF, CapturePart("leaf/hppc_25c_from_full"), (CapturePart("leaf/cc_1c", 0.001, 10_080.0, 13_650.0),)
    ),
)


def read_block(part: CapturePart, capacity_ah: float) -> Block:
    """Read a part of a capture, without glitches."""
    rows, soc = load(part.name, capacity_ah, part.initial_soc)
    samples = remove_glitches(rows, part.name)
    inside = (samples["time_s"] >= part.begin_s) & (samples["time_s"] < part.end_s)
    samples = samples[inside]
    return Block(samples, np.interp(samples["time_s"], rows["time_s"], soc))


def chosen(words: list[str]) -> list[Trial]:
    """Return the trials whose name contains one of ``words``, or all trials if there are no words."""
    return [trial for trial in TRIALS if not words or any(word in trial.name for word in words)]


def start_cells(true_cell: CellModel, temperature_c: float) -> Iterator[tuple[float, CellModel]]:
    """Yield the factor on the resistances and the resulting cell of each start."""
    for factor in START_FACTORS:
        yield factor, scale_resistances(true_cell, factor, temperature_c)


def at_temperature(cell: CellModel, temperature_c: float) -> CellModel:
    """Return the cell file with the OCV and a1..a15 (coefficients of the elements over SOC) of ``temperature_c``."""
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


def scale_resistances(cell: CellModel, factor: float, temperature_c: float) -> CellModel:
    """Return a cell with ``factor`` times the resistances at ``temperature_c``, and an RC ladder of its two RC pairs.

    The cell has no bounds for the adaptation.
    """
    sections: dict[str, object] = {"adaptation": {}}
    for name in ("r_s", "r_ts", "r_tl"):
        element = getattr(cell, name)
        ohms = {key: factor * getattr(element, key) for key in ("amplitude_ohm", "offset_ohm")}
        sections[name] = element.model_copy(update=ohms)
    changed = cell.model_copy(update=sections)
    ohm, weak = ladder_of_branches(changed).T, weak_share(SOC_GRID)
    ladder = Ladder(
        soc=tuple(SOC_GRID.tolist()),
        weak_ohm=_rows(weak * ohm / arrhenius(WEAK_J, temperature_c)),
        strong_ohm=_rows((1.0 - weak) * ohm / arrhenius(STRONG_J, temperature_c)),
        std=BRANCHES_STD,
        error_v=ELEMENT_ERROR_V,
        temperature_c=(temperature_c - TEMPERATURE_RANGE_K, temperature_c + TEMPERATURE_RANGE_K),
    )
    return changed.model_copy(update={"ladder": ladder})


def _rows(ohm: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, ohm.tolist()))


def _times(rows: tuple[tuple[float, ...], ...], factor: float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(factor * ohm for ohm in row) for row in rows)
