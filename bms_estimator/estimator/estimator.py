"""The estimator: kernel settings and state behind ``step`` and ``run``."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.records import observer_settings
from bms_estimator.kernels import estimate as kernel
from bms_estimator.kernels.estimate import Verdict
from bms_estimator.kernels.state import OBSERVER_STATE, TRACE
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import ObserverSettings

TraceBlock = NDArray[np.void]
"""Shape (n,), dtype ``TRACE``: one row for each accepted sample."""


class Estimator:
    """Estimates SOC, parameters and margins of one pack, sample by sample.

    ``run`` on a block and ``step`` on each of its samples leave the same state to the last bit.

    Args:
        cell: The pack as one two-terminal object (``CellModel.pack``).
        observer: The adaptive observer's settings.
        voltage_resolution_v: One step of the voltage converter, at the pack's terminals [V].
        initial_soc: SOC 0..1 at the first sample; None: from its voltage through the OCV.

    Attributes:
        state: Shape (1,), dtype ``OBSERVER_STATE``. It can be copied, saved, compared and put back.
    """

    def __init__(
        self,
        cell: CellModel,
        observer: ObserverSettings | None = None,
        *,
        voltage_resolution_v: float = 1e-3,
        initial_soc: float | None = None,
    ) -> None:
        self.cell = cell
        self.settings = observer_settings(cell, observer or ObserverSettings(), voltage_resolution_v, initial_soc)
        self.state: NDArray[np.void] = np.zeros(1, dtype=OBSERVER_STATE)
        self._trace: TraceBlock = np.zeros(0, dtype=TRACE)

    def step(self, time_s: float, current_a: float, voltage_v: float, status: int = 0) -> Verdict:
        """Take one sample.

        Args:
            time_s: Time stamp [s].
            current_a: Current [A], positive on discharge.
            voltage_v: Terminal voltage [V].
            status: Bits of ``SampleStatus``.

        Returns:
            Whether it was accepted, else why not; the state counts each kind.
        """
        return Verdict(kernel.step(self.state, self.settings, time_s, current_a, voltage_v, status))

    def run(self, block: SampleBlock) -> TraceBlock:
        """Take a block of samples, dtype ``SAMPLE``.

        Returns:
            A row for each accepted sample, valid until the next call.
        """
        if self._trace.size < block.size:
            self._trace = np.zeros(block.size, dtype=TRACE)
        rows = kernel.run(self.state, self.settings, block, self._trace)
        return self._trace[:rows]
