"""Load that was seen since the last long charge, second by second."""

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.model.arrays import Floats

MAX_LOAD_S = 20_000
"""Maximum length of the stored load [s]."""


class LoadHistory:
    """Mean and largest current of each second since the last long charge.

    Attributes:
        mean_a: Mean current of each second [A], oldest first, positive on discharge.
        max_a: Largest current of each second [A].
    """

    def __init__(self) -> None:
        self.mean_a: Floats = np.zeros(0)
        self.max_a: Floats = np.zeros(0)

    def add(self, trace: TraceBlock) -> None:
        """Add rows of dtype ``TRACE``."""
        self.mean_a = np.append(self.mean_a, trace["current_a"])[-MAX_LOAD_S:]
        self.max_a = np.append(self.max_a, trace["current_a"])[-MAX_LOAD_S:]
