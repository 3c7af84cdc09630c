"""Cases of the simulated month."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from tests.estimator.month.packs import draw_pack, generator
from tests.estimator.month.simulation import Ageing, simulate_use
from tests.estimator.month.sources import BMS, BMS_GAINS, BOARD, FAST_BOARD, SOLAR, SPLIT, Source, measure
from tests.estimator.month.uses import USES

NEW = Ageing()
"""Pack that does not age."""


@dataclass(frozen=True)
class Recording:
    """What the estimator receives, and the truth."""

    samples: SampleBlock
    truth: np.ndarray
    """True values at each sample, dtype ``HISTORY``."""
    chemistry: str
    declared_ah: float
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
    file: Literal["generic", "own"] = "generic"
    """Cell file: the generic one of the chemistry, or one from another cell of this type."""
    ageing: Ageing = NEW
    declared_ah: float = 3.0
    days: int = 14
    seed: int = 1

    @property
    def name(self) -> str:
        """Name without the seed."""
        aged = f", aged {self.ageing.name}" if self.ageing != NEW else ""
        return f"{self.cell}, {self.use}, {self.source.name}, {self.file}{aged}"

    def draw(self, data: Path) -> Recording:
        """Simulate the pack and its source. ``data`` is the folder of the real captures."""
        pack = draw_pack(self.cell, self.declared_ah, self.seed, data)
        use, rng = USES[self.use], generator(self.cell, self.use, self.seed)
        history = simulate_use(pack, use, self.ageing, self.days, rng, self.source.fast_day)
        samples = measure(self.source, history, generator(self.cell, self.use, self.source.name, self.seed))
        own = pack.own_file(generator(self.cell, "own file", self.seed)) if self.file == "own" else None
        seen = history[history["is_seen"]]
        return Recording(samples, seen, pack.chemistry, pack.declared_ah, own or pack.generic_file)


OXIDES, PHOSPHATES = ("LG M50", "NCR", "PF", "Leaf", "random LCO"), ("A123", "LFP")
"""Cells by kind."""
SLOW = Ageing("10 %/a", 0.1 / 365.0, 0.2 / 365.0)
FAST = Ageing("16 % in 98 d", 0.16 / 98.0, 0.5 / 98.0)
WEAK_VOLTAGE = replace(BOARD, name="voltage gain +1 %", voltage_gain=1.01, **BMS_GAINS)
WEAK_CURRENT = replace(BOARD, name="current gain +3 %", current_gain=1.03, **BMS_GAINS)

CASES: tuple[Case, ...] = (
    *(Case(cell, use) for use in ("never_full", "full_weekly") for cell in (*OXIDES, *PHOSPHATES)),
    *(Case(cell, f"never_full_above_{soc}") for soc in ("0.30", "0.50") for cell in PHOSPHATES),
    Case("LG M50", "never_full", FAST_BOARD),
    *(Case(cell, "full_nightly") for cell in ("LG M50", "Leaf", "A123")),
    *(Case(cell, use, SOLAR, declared_ah=20.0) for use in ("solar", "solar_full_weekly") for cell in PHOSPHATES),
    *(Case(cell, "bicycle") for cell in ("LG M50", "PF")),
    *(Case(cell, "boat") for cell in ("LG M50", "LFP")),
    *(Case(cell, "full_weekly", BMS) for cell in ("LG M50", "PF", "A123")),
    *(Case("NCR", "never_full", source, "own") for source in (BOARD, SPLIT, WEAK_VOLTAGE, WEAK_CURRENT)),
    *(Case("PF", "full_weekly", source) for source in (SPLIT, WEAK_VOLTAGE, WEAK_CURRENT)),
    *(Case(cell, "never_full", file="own") for cell in ("LG M50", "A123")),
    Case("PF", "bicycle", file="own"),
    Case("LG M50", "full_nightly", ageing=FAST),
    Case("PF", "full_weekly", ageing=SLOW),
)
"""Cases of the table."""
