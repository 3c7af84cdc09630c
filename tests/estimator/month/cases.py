"""Cases of the simulated weeks: combinations of cell, use, source and cell file."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from tests.estimator.month.packs import Pack, draw_pack, generator
from tests.estimator.month.simulation import Aging, simulate_use
from tests.estimator.month.sources import (
    BMS,
    BMS_GAINS,
    BOARD,
    CHANGES,
    FAST_BOARD,
    MINUTE_SKEWED,
    SKEWED,
    SLOW_BOARD,
    SOLAR,
    SPLIT,
    Source,
    measure,
)
from tests.estimator.month.uses import USES

NEW = Aging()
"""Pack that does not age."""


@dataclass(frozen=True)
class Recording:
    """Input of the estimator, and the true values."""

    samples: SampleBlock
    truth: np.ndarray
    """True values at each sample, dtype ``TRUE_VALUES``."""
    chemistry: str
    """Name of the generic cell file."""
    declared_ah: float
    """Capacity in the cell file [Ah]."""
    cell: CellModel
    """Cell file of the estimator."""


@dataclass(frozen=True)
class Case:
    """Parameters of one run."""

    cell: str
    """Name in ``packs.CHEMISTRIES``."""
    use: str
    """Name in ``uses.USES``."""
    source: Source = BOARD
    file: Literal["generic", "own", "nca"] = "generic"
    """Cell file: the generic one of the chemistry, one of another cell of this type, or the generic one of ``nca``."""
    aging: Aging = NEW
    declared_ah: float = 3.0
    """Capacity that the owner declares [Ah]."""
    days: int = 14
    seed: int = 1

    @property
    def name(self) -> str:
        """Cell, use, source and cell file, and the aging if there is one."""
        aged = f", aged {self.aging.name}" if self.aging != NEW else ""
        return f"{self.cell}, {self.use}, {self.source.name}, {self.file}{aged}"

    def draw(self, data: Path) -> Recording:
        """Simulate the pack and its source. ``data`` is the folder of the real captures."""
        pack = draw_pack(self.cell, self.declared_ah, self.seed, data)
        use, rng = USES[self.use], generator(self.cell, self.use, self.seed)
        history = simulate_use(pack, use, self.aging, self.days, rng, self.source.fast_day)
        samples = measure(self.source, history, generator(self.cell, self.use, self.source.name, self.seed))
        seen = history[history["is_seen"]]
        if self.source.topics:
            seen = seen[np.searchsorted(seen["time_s"], samples["time_s"], "right") - 1]
        return Recording(samples, seen, pack.chemistry, pack.declared_ah, self.cell_file(pack))

    def cell_file(self, pack: Pack) -> CellModel:
        """Return the cell file of the estimator."""
        if self.file == "own":
            return pack.own_file(generator(self.cell, "own file", self.seed))
        return pack.generic_file if self.file == "generic" else load_cell(self.file, pack.declared_ah)


OXIDES, PHOSPHATES = ("LG M50", "NCR", "PF", "Leaf", "random LCO"), ("A123", "LFP")
"""Cells by kind: layered oxides and spinel, and LFP. Names of ``packs.CHEMISTRIES``."""
SLOW = Aging("10 %/a", 0.1 / 365.0, 0.2 / 365.0)
FAST = Aging("16 % in 98 d", 0.16 / 98.0, 0.5 / 98.0)
LIFE = Aging("16 % in 98 d, R x2", 0.16 / 98.0, 0.3 / 98.0, 0.7 / 98.0**2, -0.015 / 98.0)
"""Life of a cell under heavy use: its resistances double, half of it in the last month, and its OCV changes by 15 mV."""
VOLTAGE_TOO_HIGH = replace(BOARD, name="voltage gain +1 %", voltage_gain=1.01, **BMS_GAINS)
CURRENT_TOO_HIGH = replace(BOARD, name="current gain +3 %", current_gain=1.03, **BMS_GAINS)

LIFE_FILES: tuple[Literal["generic", "nca"], ...] = ("generic", "nca")
"""Cell files of the case ``LIFE``: the generic file of its chemistry, and that of a similar one."""

CASES: tuple[Case, ...] = (
    *(Case(cell, use) for use in ("never_full", "full_weekly") for cell in (*OXIDES, *PHOSPHATES)),
    *(Case(cell, f"never_full_above_{soc}") for soc in ("0.30", "0.50") for cell in PHOSPHATES),
    Case("LG M50", "never_full", FAST_BOARD),
    *(Case(cell, "full_nightly") for cell in ("LG M50", "Leaf", "A123")),
    *(Case(cell, use, SOLAR, declared_ah=20.0) for use in ("solar", "solar_full_weekly") for cell in PHOSPHATES),
    *(Case(cell, "bicycle") for cell in ("LG M50", "PF")),
    *(Case(cell, "boat") for cell in ("LG M50", "LFP")),
    *(Case(cell, "full_weekly", BMS) for cell in ("LG M50", "PF", "A123")),
    *(Case("NCR", "never_full", source, "own") for source in (BOARD, SPLIT, VOLTAGE_TOO_HIGH, CURRENT_TOO_HIGH)),
    *(Case("PF", "full_weekly", source) for source in (SPLIT, VOLTAGE_TOO_HIGH, CURRENT_TOO_HIGH)),
    *(Case("NCR", "never_full", source, "own") for source in (SKEWED, MINUTE_SKEWED, CHANGES)),
    *(Case("PF", "full_weekly", source) for source in (SKEWED, MINUTE_SKEWED, CHANGES)),
    *(Case(cell, "never_full", file="own") for cell in ("LG M50", "A123")),
    Case("PF", "bicycle", file="own"),
    Case("LG M50", "full_nightly", aging=FAST),
    Case("PF", "full_weekly", aging=SLOW),
    *(Case("random LCO", "full_often_40_C", file=file, aging=LIFE) for file in LIFE_FILES),
    Case("PF", "full_weekly_10_s", SLOW_BOARD, aging=SLOW),
)
"""Cases of the table."""
