"""Data of chapter 5 of the thesis: real captures, or the simulated pack measured by two sensor chains."""

from dataclasses import dataclass
from functools import cached_property

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.reports.thesis.claims import claim
from bms_estimator.reports.thesis.procedure import Capture, Procedure, kind_of
from bms_estimator.reports.thesis.report_items import Reproduction
from bms_estimator.reports.thesis.simulated_experiment import SensorChain, captures, experiments, pack

FINE = SensorChain(bits=16)
"""Sensor chain of the dSpace board of the thesis, with 16 bits."""
COARSE = SensorChain(bits=10)
"""Sensor chain of an Arduino, with 10 bits."""


@dataclass(frozen=True)
class Recorded:
    """Real captures.

    Attributes:
        cell: Cell file with capacity, limits and bounds.
        samples: Name and samples of each capture.
        voltage_step_v: Resolution of the voltage [V].
    """

    cell: CellModel
    samples: tuple[tuple[str, SampleBlock], ...]
    voltage_step_v: float


class Experiment:
    """Experimental procedure on one pack.

    Args:
        recorded: Real captures; None for the simulated pack.
    """

    def __init__(self, recorded: Recorded | None = None) -> None:
        self.recorded = recorded

    @cached_property
    def _true_captures(self) -> list[Capture]:
        return experiments()

    @cached_property
    def procedure(self) -> Procedure:
        """Procedure on the real captures, or on the simulated pack measured with 16 bits."""
        if self.recorded is None:
            return Procedure(pack(), captures(self._true_captures, FINE), FINE.voltage_step_v)
        cell = self.recorded.cell
        captures_with_kind = [
            Capture(name, kind_of(name, samples, cell.cell.capacity_ah), samples)
            for name, samples in self.recorded.samples
        ]
        return Procedure(cell, captures_with_kind, self.recorded.voltage_step_v)

    @cached_property
    def coarse_procedure(self) -> Procedure | None:
        """Procedure on the simulated pack measured with 10 bits; None for real captures."""
        if self.recorded is not None:
            return None
        return Procedure(pack(), captures(self._true_captures, COARSE), COARSE.voltage_step_v)

    def verdict_on_claims(self, *keys: str) -> tuple[Reproduction, str]:
        """Return the common verdict on the claims ``keys`` of ``claims.CLAIMS``, and its reason.

        No claim is tested on the simulated pack, because the pack has exactly the form of the model.
        """
        if self.recorded is None:
            return Reproduction.NO_DATA, ""
        claims = [claim(key, [self.procedure]) for key in keys]
        reason = "".join(f"{tested.sentence} " for tested in claims)
        verdicts = {tested.verdict for tested in claims} - {Reproduction.NO_DATA}
        if not verdicts:
            return Reproduction.NO_DATA, reason
        return (Reproduction.CLAIM_FAILS if Reproduction.CLAIM_FAILS in verdicts else Reproduction.CLAIM_HOLDS), reason

    @property
    def truth(self) -> Floats | None:
        """True a1..a21 of the simulated pack at index 1..21; None for real captures."""
        return pack().a if self.recorded is None else None

    @property
    def data_source(self) -> str:
        """Description of the data source."""
        if self.recorded is None:
            return "the simulated 6S pack"
        return f"{len(self.recorded.samples)} captures of {self.recorded.cell.cell.name}"

    @property
    def unpublished(self) -> str:
        """Reason for which the printed numbers cannot be reproduced."""
        return f"The thesis's recordings are not published. Its procedure was run on {self.data_source}."
