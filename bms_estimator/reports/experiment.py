"""Data of chapter 5: real captures, or the simulated pack through two sensor chains."""

from dataclasses import dataclass
from functools import cached_property

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.reports.procedure import Capture, Procedure, kind_of
from bms_estimator.reports.report_items import Reproduction
from bms_estimator.reports.simulated_experiment import SensorChain, captures, experiments, pack
from bms_estimator.reports.thesis_claims import claim

FINE, COARSE = SensorChain(16), SensorChain(10)
"""The dSpace board of the thesis, and an Arduino."""


@dataclass(frozen=True)
class Recorded:
    """Real captures.

    Attributes:
        cell: The cell file: capacity, limits, bounds.
        samples: Name and samples of each.
        voltage_step_v: One step of the voltage converter [V].
    """

    cell: CellModel
    samples: tuple[tuple[str, SampleBlock], ...]
    voltage_step_v: float


class Experiment:
    """The protocol on one pack.

    Args:
        recorded: Real captures; None for the simulated pack.
    """

    def __init__(self, recorded: Recorded | None = None) -> None:
        self.recorded = recorded

    @cached_property
    def _true(self) -> list[Capture]:
        return experiments()

    @cached_property
    def protocol(self) -> Procedure:
        """On the real captures, or on the simulated pack through 16 bits."""
        if self.recorded is None:
            return Procedure(pack(), captures(self._true, FINE), FINE.voltage_step_v)
        cell = self.recorded.cell
        found = [Capture(name, kind_of(name, s, cell.cell.capacity_ah), s) for name, s in self.recorded.samples]
        return Procedure(cell, found, self.recorded.voltage_step_v)

    @cached_property
    def coarse(self) -> Procedure | None:
        """On the simulated pack through 10 bits; None for real captures."""
        if self.recorded is not None:
            return None
        return Procedure(pack(), captures(self._true, COARSE), COARSE.voltage_step_v)

    def tested(self, *keys: str) -> tuple[Reproduction, str]:
        """Verdict on one or more of ``claims.CLAIMS``, all of which must hold on the captures, and why, in words.

        Nothing is tested on the simulated pack: it has the model's own form.
        """
        if self.recorded is None:
            return Reproduction.NO_DATA, ""
        found = [claim(key, [self.protocol]) for key in keys]
        words = "".join(f"{one.words} " for one in found)
        verdicts = {one.verdict for one in found} - {Reproduction.NO_DATA}
        if not verdicts:
            return Reproduction.NO_DATA, words
        return (Reproduction.CLAIM_FAILS if Reproduction.CLAIM_FAILS in verdicts else Reproduction.CLAIM_HOLDS), words

    @property
    def truth(self) -> Floats | None:
        """a1..a21 of the simulated pack at index 1..21; None for real captures."""
        return pack().a if self.recorded is None else None

    @property
    def on(self) -> str:
        """Return the source of the numbers."""
        if self.recorded is None:
            return "the simulated 6S pack"
        return f"{len(self.recorded.samples)} captures of {self.recorded.cell.cell.name}"

    @property
    def unpublished(self) -> str:
        """Reason why the printed numbers cannot result."""
        return f"The thesis's recordings are not published. Its procedure was run on {self.on}."
