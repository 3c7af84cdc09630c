"""Captures of the benchmark with their cell files."""

from dataclasses import dataclass
from pathlib import Path

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.settings.observer import BOARD
from tests.benchmarks.recipes import Recipe, cell_file, load


@dataclass(frozen=True)
class Capture:
    """Capture with the recipe of its cell file and the SOC at its first sample."""

    name: str
    recipe: Recipe
    file: str
    soc: float = 1.0

    @property
    def capacity_ah(self) -> float:
        """Declared capacity of the cell [Ah]."""
        return self.recipe.capacity_ah

    @property
    def samples(self) -> SampleBlock:
        """Samples without invalid voltages."""
        return load(self.file, self.capacity_ah, self.soc)[0]

    def estimator(self, folder: Path) -> Estimator:
        """Return an estimator that starts at the true SOC. Cell files are written to ``folder``."""
        return Estimator(cell_file(self.recipe, folder), initial_soc=self.soc, sampling=BOARD)
